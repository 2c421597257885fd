"""A study of what a checkpoint needs: one setting changed at a time, on the same courses.

python -m benchmarks.study --episodes 10 --json docs/dev/study.json --plot docs/images/study.png
--checkpoint fast.safetensors --without-age fast_without_age.safetensors

Each row is a ``mavbridge evaluate`` of its own. Rows that the JSON holds for the same checkpoints
and as many episodes are not flown again: an interrupted study resumes.
"""

import hashlib
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from json import dumps, loads
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from cyclopts import App

from mavbridge.commands.output import (
    BLUE,
    FIGURE_DPI,
    FIGURE_STYLE,
    MUTED,
    make_table,
    require_outputs,
    table_console,
)
from policy.loading.builtin import SHIPPED

DUAL, FROM_NOISE = "--dual-rate", "--num-diffusion-steps"
DELAYS_MS = (0, 30, 60, 100, 150)
DELAYED, DELAYED_WITHOUT_AGE = "late images", "late images, age unknown"
app = App(help=__doc__)


class Setting(NamedTuple):
    """One row of the study."""

    group: str
    name: str
    flags: str


def rates(visual_hz: int, action_hz: int) -> str:
    """Return the flags for these rates."""
    return f"--set-config rates.visual={visual_hz} --set-config rates.action={action_hz}"


SETTINGS = (
    Setting("rates", "30 images, 100 actions a second; 1 step", DUAL),
    Setting("rates", "14 and 32", f"{FROM_NOISE} 10 {rates(14, 32)}"),
    Setting(  # eager torch takes 55 ms longer than 11 ms for an image, at 14 images a second
        "rates",
        "14 and 32, encoding 55 ms longer: eager torch",
        f"{FROM_NOISE} 10 {rates(14, 32)} --set-config limits.feature_age=0.5 --vision-delay 55",
    ),
    Setting(  # benchmarks.baseline with EfficientNet-B3 on two cores without AVX-512
        "rates",
        "5 and 10, encoding 170 ms longer: baseline",
        f"{FROM_NOISE} 10 {rates(5, 10)} --set-config limits.feature_age=1 --vision-delay 170",
    ),
    Setting(
        "rates", "single rate, 30", f"--single-rate --set-config rates.single=30 {FROM_NOISE} 10"
    ),
    Setting("rates", "50 actions", f"{DUAL} --set-config rates.action=50"),
    Setting("rates", "250 actions", f"{DUAL} --set-config rates.action=250"),
    Setting("steps", "10 steps, from noise", f"{FROM_NOISE} 10"),
    Setting("steps", "4 steps, from noise", f"{FROM_NOISE} 4"),
    Setting("steps", "2 steps, from noise", f"{FROM_NOISE} 2"),
    Setting(
        "smoothing",
        "no smoothing",
        f"{DUAL} --set-config limits.tau=0 --set-config limits.slew=1000",
    ),
    Setting("vehicle", "other vehicles, firmware, wind, light", f"{DUAL} --conditions random"),
    *(
        Setting(
            group,
            f"images {delay_ms} ms later{group.removeprefix(DELAYED)}",
            f"{DUAL} --set-config limits.feature_age=0.5 --vision-delay {delay_ms}",
        )
        for group in (DELAYED, DELAYED_WITHOUT_AGE)
        for delay_ms in DELAYS_MS
    ),
)
"""Each changes one thing of the first."""


@dataclass(frozen=True, kw_only=True)
class SettingScore:
    """One evaluated setting; intervals are 95 %."""

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


@app.default
def main(
    *,
    json: Path,
    plot: Path | None = None,
    checkpoint: Path = SHIPPED,
    without_age: Path | None = None,
    episodes: int = 25,
    workers: int = 1,
) -> None:
    """Evaluate what has not been evaluated yet, then print and draw.

    Args:
        json: where the scores are kept.
        plot: where to draw them as PNG.
        checkpoint: what flies.
        without_age: a checkpoint of the same training with ``--no-since-exposure``, which flies
            with late images, too.
        episodes: courses for each setting.
        workers: episodes at a time.
    """
    require_outputs(json, plot)
    scores = stored(json, episodes)
    rows = []
    for setting in SETTINGS:
        flown = without_age if setting.group == DELAYED_WITHOUT_AGE else checkpoint
        if flown is None:
            continue
        score = scores.get((setting.name, sha256(flown)))
        if score is None:
            score = evaluate(setting, flown, episodes, workers)
            print_scores([score])
        rows.append(score)
        scores[score.name, score.checkpoint_sha256] = score
        json.write_text(dumps([asdict(one) for one in scores.values()], indent=2) + "\n")
    print_scores(rows)
    if plot is not None:
        draw(rows, plot)


def stored(path: Path, episodes: int) -> dict[tuple[str, str], SettingScore]:
    """Scores of earlier runs with as many episodes, by name and hash of the checkpoint."""
    scores = [SettingScore(**one) for one in loads(path.read_text())] if path.exists() else []
    return {(one.name, one.checkpoint_sha256): one for one in scores if one.episodes == episodes}


def evaluate(setting: Setting, checkpoint: Path, episodes: int, workers: int) -> SettingScore:
    """Fly one setting.

    Raises:
        subprocess.CalledProcessError: the evaluation failed, and printed why.
    """
    flags = f"{setting.flags} --episodes {episodes}"
    flown = fly(flags, checkpoint, workers)
    return SettingScore(
        group=setting.group,
        name=setting.name,
        command=f"mavbridge evaluate {flags}",
        checkpoint_sha256=sha256(checkpoint),
        episodes=episodes,
        success=flown.success,
        success_low=flown.success_low,
        success_high=flown.success_high,
        gates=flown.gates,
        speed_mps=flown.speed_mps,
        stick_rate_per_s=flown.stick_rate_per_s,
    )


class Flown(NamedTuple):
    """Figures of one ``mavbridge evaluate``; intervals are 95 %. NaN: no flight has the figure."""

    success: float
    success_low: float
    success_high: float
    gates: float
    speed_mps: float
    course_speed_mps: float
    stick_rate_per_s: float


def fly(flags: str, checkpoint: Path, workers: int) -> Flown:
    """Run ``mavbridge evaluate`` with these flags.

    Raises:
        subprocess.CalledProcessError: the evaluation failed, and printed why.
    """
    with TemporaryDirectory() as folder:
        out = Path(folder) / "evaluation.json"
        files = ("--checkpoint", str(checkpoint), "--workers", str(workers), "--json", str(out))
        command = [sys.executable, "-m", "mavbridge", "evaluate", *flags.split(), *files]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        summary = loads(out.read_text())["summary"]

    def value(name: str) -> float:
        return float(summary[name]["value"]) if summary[name] else math.nan

    return Flown(
        success=value("success_rate"),
        success_low=summary["success_rate"]["low"],
        success_high=summary["success_rate"]["high"],
        gates=value("gates_passed"),
        speed_mps=value("mean_speed_mps"),
        course_speed_mps=value("course_speed_mps"),
        stick_rate_per_s=value("stick_rate_per_s"),
    )


def print_scores(scores: Sequence[SettingScore]) -> None:
    """Print the table of docs/dev/study.md."""
    rows = [
        (
            *(one.name, f"{one.success:.0%}", f"{one.success_low:.0%} to {one.success_high:.0%}"),
            *(f"{one.gates:.1f}", f"{one.speed_mps:.1f}", f"{one.stick_rate_per_s:.2f}"),
        )
        for one in scores
    ]
    header = ("setting", "courses flown", "95 %", "gates of 8", "m/s", "sticks, 1/s")
    table_console().print(make_table("Held-out courses", header, rows))


def draw(scores: Sequence[SettingScore], path: Path) -> None:
    """Write a PNG: success by setting, and by the delay of the images."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(12.0, 5.2), dpi=FIGURE_DPI, facecolor="white")
        left, right = figure.subplots(1, 2, width_ratios=(3, 2))
        draw_settings(left, [one for one in scores if not one.group.startswith(DELAYED)])
        draw_delays(right, scores)
        figure.tight_layout(w_pad=3)
        figure.savefig(path)


def draw_settings(axes: Any, scores: Sequence[SettingScore]) -> None:
    """A bar for each setting, in percent, with its interval; the first one at the top."""
    for row, one in enumerate(reversed(scores)):
        axes.barh(one.name, 100 * one.success, 0.6, color=BLUE)
        axes.hlines(row, 100 * one.success_low, 100 * one.success_high, color=MUTED)
        axes.text(103, row, f"{100 * one.success:.0f} %", va="center")
    axes.set_xlim(0, 115)
    axes.set_title("Held-out courses flown, %, with 95 % interval")


def draw_delays(axes: Any, scores: Sequence[SettingScore]) -> None:
    """Success in percent by delay, with its interval: a line with the age and one without."""
    for group, color, name in (
        (DELAYED, BLUE, "with their age"),
        (DELAYED_WITHOUT_AGE, MUTED, "without"),
    ):
        delayed = [one for one in scores if one.group == group]
        delays_ms = DELAYS_MS[: len(delayed)]
        success, low, high = (
            [100 * getattr(one, field) for one in delayed]
            for field in ("success", "success_low", "success_high")
        )
        axes.fill_between(delays_ms, low, high, color=color, alpha=0.15, linewidth=0)
        axes.plot(delays_ms, success, "o-", color=color, label=name if delayed else None)
    axes.set_ylim(-3, 103)
    axes.set_xlabel("ms added to the encoding of each image")
    axes.set_title("Late images")
    axes.legend(loc="lower left")


def sha256(path: Path) -> str:
    """Hash of a file, in hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    app()
