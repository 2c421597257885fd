"""What makes a checkpoint fly well or badly: one setting changed at a time, the same courses.

    python -m benchmarks.study --episodes 25 --json docs/study.json --plot docs/study.png \\
        --checkpoint fast.safetensors --untold fast_untold.safetensors

Each row is a ``mavbridge evaluate`` of its own. Rows that the JSON holds for the same checkpoints
and as many episodes are not flown again: an interrupted study goes on. ``--untold`` is a checkpoint
made by the same training with ``--no-since-exposure``: late images are asked of both.
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
BASE = "30 images, 100 actions a second; 2 of 10 steps"
DELAYS_MS = (0, 30, 60, 100, 150)
OLD_IMAGES = ("--max-feature-age", "0.5")
"""So that a late image is flown by, and not refused."""
EAGER_RATES = ("--visual-rate", "14", "--action-rate", "32")
EAGER_DELAY_MS = "55"
"""That eager torch encodes an image slower than 11 ms, at 14 images a second."""
USUAL_RATES = ("--visual-rate", "5", "--action-rate", "10")
USUAL_DELAY_MS = "170"
"""Of the usual runner with EfficientNet-B3 on two cores without AVX-512 (``make bench``), less its
backlog of states."""
SIZE_INCHES = (12.0, 5.2)
LATE, LATE_UNTOLD = "late images", "late images, age not told"


@dataclass(frozen=True, kw_only=True)
class Question:
    """One row: what it asks, and the flags that fly it."""

    group: str
    name: str
    flags: tuple[str, ...]

    @property
    def is_untold(self) -> bool:
        """Whether it is asked of the checkpoint that is not told how old its image is."""
        return self.group == LATE_UNTOLD


@dataclass(frozen=True, kw_only=True)
class Answer:
    """Of one evaluation; intervals are 95 %."""

    group: str
    name: str
    command: str
    checkpoint_sha256: str
    episodes: int
    success: float
    success_low: float
    success_high: float
    gates: float
    speed_mps: float
    stick_rate_per_s: float


def questions(*, with_untold: bool) -> tuple[Question, ...]:
    """In the order of the table."""
    eager = ("--dual-rate", *EAGER_RATES)
    rows = [
        ("rates", BASE, DUAL),
        ("rates", "14 and 32", eager),
        (
            "rates",
            "14 and 32, encoding 55 ms longer: eager torch",
            (*eager, *OLD_IMAGES, "--vision-delay", EAGER_DELAY_MS),
        ),
        (
            "rates",
            "5 and 10, encoding 170 ms longer: usual runner",
            (
                *("--dual-rate", *USUAL_RATES),
                *("--max-feature-age", "1", "--vision-delay", USUAL_DELAY_MS),
            ),
        ),
        ("rates", "single rate, 30", ("--rate", "30")),
        ("rates", "50 actions", (*DUAL, "--action-rate", "50")),
        ("rates", "250 actions", (*DUAL, "--action-rate", "250")),
        ("steps", "10 steps, from noise", ("--dual-rate",)),
        *[
            (
                "steps",
                f"{n} step{'s' * (n > 1)}, from noise",
                ("--dual-rate", "--num-diffusion-steps", str(n)),
            )
            for n in (4, 2, 1)
        ],
        ("steps", "1 of 10 steps, warm start", ("--dual-rate", "--head-steps", "1")),
        ("smoothing", "no smoothing", (*DUAL, "--tau", "0", "--max-slew", "1000")),
        ("vehicle", "other vehicles, firmware, wind, light", (*DUAL, "--conditions", "random")),
    ]
    for group in (LATE, LATE_UNTOLD) if with_untold else (LATE,):
        rows += [
            (
                group,
                f"images {delay_ms} ms later" + (", age not told" if group == LATE_UNTOLD else ""),
                (*DUAL, *OLD_IMAGES, "--vision-delay", str(delay_ms)),
            )
            for delay_ms in DELAYS_MS
        ]
    return tuple(Question(group=group, name=name, flags=flags) for group, name, flags in rows)


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
        checkpoint_sha256=_sha256(checkpoint),
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

    from mavbridge.commands.evaluate.figure import BLUE, DOTS_PER_INCH, MUTED, STYLE

    others = [one for one in answers if one.group not in (LATE, LATE_UNTOLD)][::-1]
    with rc_context(STYLE):
        figure = Figure(figsize=SIZE_INCHES, dpi=DOTS_PER_INCH, facecolor="white")
        left, right = figure.subplots(1, 2, width_ratios=(3, 2))
        shares = [100 * one.success for one in others]
        left.barh([one.name for one in others], shares, 0.6, color=BLUE)
        for row, one in enumerate(others):
            ends = (100 * one.success_low, 100 * one.success_high)
            left.plot(ends, (row, row), color=MUTED, linewidth=1.5)
            left.text(103, row, f"{shares[row]:.0f} %", va="center")
        left.set_xlim(0, 115)
        left.set_title("Held-out courses flown, %, with 95 % interval")
        for group, color, name in ((LATE, BLUE, "told the age"), (LATE_UNTOLD, MUTED, "not told")):
            late = [one for one in answers if one.group == group]
            delays_ms = list(DELAYS_MS[: len(late)])
            low, high = (
                [100 * getattr(one, f"success_{end}") for one in late] for end in ("low", "high")
            )
            right.fill_between(delays_ms, low, high, color=color, alpha=0.15, linewidth=0)
            shown = [100 * one.success for one in late]
            right.plot(delays_ms, shown, "o-", color=color, label=name if late else None)
        right.set_ylim(-3, 103)
        right.set_xlabel("ms added to the encoding of each image")
        right.set_title("Late images")
        right.legend(loc="lower left")
        figure.tight_layout(w_pad=3)
        figure.savefig(path)


def _stored(path: Path) -> list[Answer]:
    return [Answer(**one) for one in json.loads(path.read_text())] if path.exists() else []


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def main() -> None:
    """Ask what has not been asked yet, then print and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--checkpoint", type=Path, default=SHIPPED)
    parser.add_argument("--untold", type=Path, help="a checkpoint without --since-exposure")
    parser.add_argument("--episodes", type=int, default=25)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()
    asked = {
        answer.name: answer
        for answer in _stored(args.json)
        if answer.checkpoint_sha256 in map(_sha256, filter(None, (args.checkpoint, args.untold)))
        and answer.episodes == args.episodes
    }
    rows: list[Answer] = []
    for question in questions(with_untold=args.untold is not None):
        checkpoint = args.untold if question.is_untold else args.checkpoint
        if question.name not in asked:
            asked[question.name] = ask(question, checkpoint, args.episodes, args.workers)
            print_answers([asked[question.name]])
        rows.append(asked[question.name])
        args.json.write_text(json.dumps([asdict(one) for one in asked.values()], indent=2) + "\n")
    print_answers(rows)
    if args.plot is not None:
        draw(rows, args.plot)


if __name__ == "__main__":
    main()
