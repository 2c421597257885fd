"""What makes a checkpoint fly well or badly: one setting changed at a time, the same courses.

    python -m benchmarks.study --episodes 25 --json docs/study.json --plot docs/study.png

Each row is a ``mavbridge evaluate`` of its own. Rows that the JSON holds for the same checkpoint
and as many episodes are not flown again: an interrupted study goes on.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from policy.loading import SHIPPED

DUAL = ("--dual-rate", "--head-steps", "2")
BASE = "30 images, 100 actions a second"
DELAYS_MS = (0, 30, 60, 100, 150)
OLD_IMAGES = ("--max-feature-age", "0.5")
"""So that a late image is flown by, and not refused."""


@dataclass(frozen=True, kw_only=True)
class Question:
    """One row: what it asks, and the flags that fly it."""

    group: str
    name: str
    flags: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Answer:
    """Of one evaluation; intervals are 95 %."""

    group: str
    name: str
    command: str
    episodes: int
    success: float
    success_low: float
    success_high: float
    gates: float
    speed_mps: float
    stick_rate_per_s: float


def questions() -> tuple[Question, ...]:
    """In the order of the table."""
    eager = ("--dual-rate", "--visual-rate", "14", "--action-rate", "32")
    rows = [
        ("rates", BASE, DUAL),
        ("rates", "14 and 32, what eager torch reached", eager),
        ("rates", "single rate, 30", ("--rate", "30")),
        ("rates", "50 actions", (*DUAL, "--action-rate", "50")),
        ("rates", "250 actions", (*DUAL, "--action-rate", "250")),
        ("steps", "10 steps, each solve from noise", ("--dual-rate",)),
        *[
            ("steps", f"{n} steps", ("--dual-rate", "--num-diffusion-steps", str(n)))
            for n in (4, 2, 1)
        ],
        ("steps", "1 of 10, warm start", ("--dual-rate", "--head-steps", "1")),
        ("smoothing", "no smoothing", (*DUAL, "--tau", "0", "--max-slew", "1000")),
        ("vehicle", "other vehicles, firmware, wind, light", (*DUAL, "--conditions", "random")),
    ]
    made = [Question(group=group, name=name, flags=flags) for group, name, flags in rows]
    for delay_ms in DELAYS_MS:
        flags = (*DUAL, *OLD_IMAGES, "--vision-delay", str(delay_ms))
        made.append(Question(group="delay", name=f"images {delay_ms} ms later", flags=flags))
    return tuple(made)


def ask(question: Question, checkpoint: Path, episodes: int, workers: int) -> Answer:
    """Fly it.

    Raises:
        subprocess.CalledProcessError: the evaluation failed, and has said why.
    """
    flags = (*question.flags, "--episodes", str(episodes))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "evaluation.json"
        given = ("--checkpoint", str(checkpoint), "--workers", str(workers), "--json", str(out))
        command = [sys.executable, "-m", "mavbridge", "evaluate", *flags, *given]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        summary = json.loads(out.read_text())["summary"]
    return Answer(
        group=question.group,
        name=question.name,
        command=f"mavbridge evaluate {' '.join(flags)}",
        episodes=episodes,
        success=summary["success_rate"]["value"],
        success_low=summary["success_rate"]["low"],
        success_high=summary["success_rate"]["high"],
        gates=summary["gates_passed"]["value"],
        speed_mps=summary["mean_speed_mps"]["value"],
        stick_rate_per_s=summary["stick_rate_per_s"]["value"],
    )


def print_answers(answers: Sequence[Answer]) -> None:
    """The table of the README."""
    table = Table("setting", "courses flown", "95 %", "gates of 8", "m/s", "sticks, 1/s")
    for one in answers:
        table.add_row(
            one.name,
            f"{one.success:.0%}",
            f"{one.success_low:.0%} to {one.success_high:.0%}",
            f"{one.gates:.1f}",
            f"{one.speed_mps:.1f}",
            f"{one.stick_rate_per_s:.2f}",
        )
    Console().print(table)


def draw(answers: Sequence[Answer], path: Path) -> None:
    """Success by setting, and gates by the age of the images."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from mavbridge.evaluation.figure import BLUE, DOTS_PER_INCH, MUTED, SIZE_INCHES, STYLE

    late = [one for one in answers if one.group == "delay"]
    others = [one for one in answers if one.group != "delay"][::-1]
    with rc_context(STYLE):
        figure = Figure(figsize=SIZE_INCHES, dpi=DOTS_PER_INCH, facecolor="white")
        left, right = figure.subplots(1, 2, width_ratios=(3, 2))
        shares = [100 * one.success for one in others]
        bars = left.barh([one.name for one in others], shares, 0.6, color=BLUE)
        left.bar_label(bars, [f"{share:.0f} %" for share in shares], padding=4)
        for row, one in enumerate(others):
            ends = (100 * one.success_low, 100 * one.success_high)
            left.plot(ends, (row, row), color=MUTED, linewidth=1.5)
        left.set_xlim(0, 115)
        left.set_title("Held-out courses flown, %, with 95 % interval")
        delays_ms = list(DELAYS_MS[: len(late)])
        low, high = ([100 * getattr(o, f"success_{end}") for o in late] for end in ("low", "high"))
        right.fill_between(delays_ms, low, high, color=BLUE, alpha=0.15, linewidth=0)
        right.plot(delays_ms, [100 * one.success for one in late], "o-", color=BLUE)
        right.set_ylim(-3, 103)
        right.set_xlabel("ms added to the encoding of each image")
        right.set_title("Late images")
        figure.tight_layout(w_pad=3)
        figure.savefig(path)


def main() -> None:
    """Ask what has not been asked yet, then print and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--checkpoint", type=Path, default=SHIPPED)
    parser.add_argument("--episodes", type=int, default=25)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()
    digest = hashlib.sha256(args.checkpoint.read_bytes()).hexdigest()
    stored = json.loads(args.json.read_text()) if args.json.exists() else {}
    known = stored.get("answers", []) if stored.get("checkpoint_sha256") == digest else []
    answers = [Answer(**one) for one in known if one["episodes"] == args.episodes]
    asked = {one.name: one for one in answers}
    for question in questions():
        if question.name not in asked:
            asked[question.name] = ask(question, args.checkpoint, args.episodes, args.workers)
        rows = [asked[q.name] for q in questions() if q.name in asked]
        document = {"checkpoint_sha256": digest, "answers": [asdict(row) for row in rows]}
        args.json.write_text(json.dumps(document, indent=2) + "\n")
        print_answers(rows[-1:])
    print_answers(rows)
    if args.plot is not None:
        draw(rows, args.plot)


if __name__ == "__main__":
    main()
