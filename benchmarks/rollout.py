"""Imagined flights: the plain serial way beside the streamed one.

python -m benchmarks.rollout --json rollout.json --plot docs/rollout.png
"""

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from cyclopts import App
from rich.console import Console
from rich.table import Table
from rich.text import Text

from benchmarks.rollout_process import COMMAND, FRAMES, RolloutJob, Trial
from mavbridge.commands.bench.results import from_json, this_machine
from mavbridge.commands.bench.tables import make_table, number
from mavbridge.commands.imagine.run import SHIPPED
from mavbridge.commands.output import (
    BLUE,
    FIGURE_DPI,
    FIGURE_STYLE,
    MUTED,
    RED,
    print_status,
    require_matplotlib,
    require_writable,
    table_console,
)
from mavbridge.core.processes import running, wait
from policy.checkpoints.world_model_file import load_world_model

TIMEOUT_S = 3600.0
THEIRS = "#a9b4bf"
app = App(help=__doc__)


@dataclass(frozen=True, kw_only=True)
class Effort:
    """The rollouts to measure."""

    iterations: tuple[int, ...]
    ddim_steps_long: int
    """With each number of iterations."""
    ddim_steps: tuple[int, ...]
    iterations_short: int
    """With each number of steps."""
    repeats: int
    """The latter; the median by wall time counts."""


FULL = Effort(
    iterations=(8, 64, 256),
    ddim_steps_long=4,
    ddim_steps=(1, 2, 4, 8, 16, 32, 50),
    iterations_short=8,
    repeats=3,
)
QUICK = Effort(
    iterations=(2, 8), ddim_steps_long=2, ddim_steps=(1, 4), iterations_short=2, repeats=1
)


@dataclass(frozen=True, kw_only=True)
class Pair:
    """The same rollout both ways."""

    serial: Trial
    streamed: Trial

    @property
    def speed_up(self) -> float:
        """Serial over streamed time."""
        return self.serial.wall_s / self.streamed.wall_s

    @property
    def bound(self) -> float:
        """Amdahl's: the speed-up if all but the sampling took no time."""
        return self.serial.wall_s / self.serial.sample_s

    @property
    def is_exact(self) -> bool:
        """The same frames, bit for bit."""
        return self.serial.sha256 == self.streamed.sha256

    def to_dict(self) -> dict[str, Any]:
        """For JSON, with the figures that follow from the trials."""
        derived = {"speed_up": self.speed_up, "bound": self.bound, "is_exact": self.is_exact}
        return asdict(self) | derived


@app.default
def main(
    *,
    quick: bool = False,
    json: Path | None = None,
    plot: Path | None = None,
    world_model: Path | None = None,
) -> int:
    """Measure; 1 if the two ways do not give the same frames.

    Args:
        quick: short rollouts, to look at and not to quote.
        json: where to write all figures.
        plot: where to draw them as PNG.
        world_model: weights; by default those that come with mavbridge.
    """
    require_writable(json, "--json")
    require_writable(plot, "--plot")
    if plot is not None:
        require_matplotlib()
    weights = world_model or SHIPPED
    load_world_model(weights)  # refuses what is no world model before the first process starts
    by_iterations, by_steps = measure(QUICK if quick else FULL, weights)
    print_pairs(by_iterations, by_steps, table_console())
    if json is not None:
        write_json(json, by_iterations, by_steps)
    if plot is not None:
        draw(by_iterations, by_steps, plot)
    return 0 if all(pair.is_exact for pair in (*by_iterations, *by_steps)) else 1


def measure(effort: Effort, weights: Path) -> tuple[list[Pair], list[Pair]]:
    """Pairs by iterations and pairs by steps, one after the other, on every device."""
    by_iterations, by_steps = [], []
    for device in ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",):
        for iterations in effort.iterations:
            steps = effort.ddim_steps_long
            by_iterations.append(compare(device, iterations, steps, 1, weights))
        for steps in effort.ddim_steps:
            iterations = effort.iterations_short
            by_steps.append(compare(device, iterations, steps, effort.repeats, weights))
    return by_iterations, by_steps


def compare(device: str, iterations: int, steps: int, repeats: int, weights: Path) -> Pair:
    """Both ways in turn, so that a machine that changes meanwhile does to both."""
    print_status(f"{iterations} iterations of {steps} steps on {device}, both ways")
    serial = RolloutJob(
        way="serial", iterations=iterations, ddim_steps=steps, device=device, world_model=weights
    )
    streamed = replace(serial, way="streamed")
    pairs = [(run_trial(serial), run_trial(streamed)) for _ in range(repeats)]
    plain, ours = zip(*pairs, strict=True)
    return Pair(serial=median_trial(plain), streamed=median_trial(ours))


def run_trial(job: RolloutJob) -> Trial:
    """One rollout in a process of its own.

    Raises:
        UserError: it failed; quotes the end of its log.
    """
    with TemporaryDirectory(prefix="mavbridge-bench-") as name:
        out, log = Path(name) / "trial.json", Path(name) / "trial.log"
        flags = [f"--{key.replace('_', '-')}={value}" for key, value in asdict(job).items()]
        command = (sys.executable, "-c", COMMAND, f"--out={out}", *flags)
        with running(*command, log=log) as process:
            wait(process, f"the {job.way} rollout", log, TIMEOUT_S)
        return from_json(Trial, out.read_text())


def median_trial(trials: Sequence[Trial]) -> Trial:
    """The trial whose wall time is the median (the lower one of two)."""
    return sorted(trials, key=lambda trial: trial.wall_s)[(len(trials) - 1) // 2]


def print_pairs(by_iterations: Sequence[Pair], by_steps: Sequence[Pair], console: Console) -> None:
    """Print both tables, and whether the frames were the same."""
    pairs = (*by_iterations, *by_steps)
    console.print(trial_table(by_iterations))
    rows = [
        (
            *(pair.serial.device, str(pair.serial.ddim_steps)),
            *(number(pair.serial.wall_s, 2), number(pair.streamed.wall_s, 2)),
            *(number(pair.speed_up, 2), number(pair.bound, 2)),
        )
        for pair in by_steps
    ]
    title = "Speed-up by DDIM steps; bound: if all but the sampling took no time"
    header = ("device", "steps", "serial, s", "streamed, s", "speed-up", "bound")
    console.print(make_table(title, header, rows))
    if all(pair.is_exact for pair in pairs):
        console.print(f"all {len(pairs)} pairs have the same frames, bit for bit")
    else:
        console.print(Text("the two ways did not give the same frames", style="bold red"))


def trial_table(pairs: Iterable[Pair]) -> Table:
    """A row for each way and number of iterations."""
    seconds = ("start_s", "wall_s", "sample_s", "decode_s", "write_s")
    megabytes = ("peak_rss_mb", "writer_rss_mb", "peak_gpu_mb")
    counts = ("iterations", "torch_threads", "frames_decoded")
    rows = [
        (
            f"{trial.way}, {trial.device}",
            *(str(getattr(trial, name)) for name in counts),
            *(number(getattr(trial, name), 2) for name in seconds),
            *(number(getattr(trial, name), 0) for name in megabytes),
        )
        for pair in pairs
        for trial in (pair.serial, pair.streamed)
    ]
    header = ["way", "iterations", "threads", "decoded", "start", "wall", "sampling"]
    header += ["pixels", "files", "nets", "writer", "GPU"]
    return make_table(
        "Time, s, with waits for pixels and files; peak memory of processes and GPU, MB",
        header,
        rows,
    )


def write_json(path: Path, by_iterations: Sequence[Pair], by_steps: Sequence[Pair]) -> None:
    """Write all figures; null = not measured."""
    document = {
        "machine": asdict(this_machine()),
        "by_iterations": [pair.to_dict() for pair in by_iterations],
        "by_steps": [pair.to_dict() for pair in by_steps],
    }
    path.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n")


def draw(by_iterations: Sequence[Pair], by_steps: Sequence[Pair], path: Path) -> None:
    """Write a PNG: speed-up by steps, memory by iterations."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter

    with rc_context(FIGURE_STYLE | {"axes.grid.axis": "y"}):
        figure = Figure(figsize=(11.0, 4.4), dpi=FIGURE_DPI, facecolor="white")
        left, right = figure.subplots(1, 2)
        draw_speed_up(left, by_steps)
        draw_memory(right, by_iterations)
        for axes in (left, right):
            axes.set_xscale("log", base=2)
            axes.set_xticks(sorted({float(x) for line in axes.lines for x in line.get_xdata()}))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.minorticks_off()
            axes.set_ylim(0, 1.2 * axes.get_ylim()[1])
            axes.legend(loc="best")
        here = this_machine()
        caption = f"{here.cpu}, cores: {here.cores}; {FRAMES} frames an iteration"
        figure.text(0.012, 0.015, caption, color=MUTED, fontsize=8.5)
        figure.tight_layout(rect=(0, 0.05, 1, 1), w_pad=3)
        figure.savefig(path)


def draw_speed_up(axes: Any, pairs: Sequence[Pair]) -> None:
    """Measured speed-up and its bound by steps, a pair of lines for each device."""
    for device, style in (("cpu", "-"), ("cuda", "--")):
        there = [pair for pair in pairs if pair.serial.device == device]
        if there:
            steps = [pair.serial.ddim_steps for pair in there]
            measured, bound = [one.speed_up for one in there], [one.bound for one in there]
            axes.plot(steps, measured, style, marker="o", color=BLUE, label=f"measured, {device}")
            axes.plot(steps, bound, style, color=RED, label=f"Amdahl's bound, {device}")
    axes.set_xlabel("DDIM steps of a sample")
    axes.set_title("Speed-up over the serial path")


def draw_memory(axes: Any, pairs: Sequence[Pair]) -> None:
    """Peak memory on the CPU by iterations, a line for each way."""
    there = [pair for pair in pairs if pair.serial.device == "cpu"]
    iterations = [pair.serial.iterations for pair in there]
    for way, color in (("serial", THEIRS), ("streamed", BLUE)):
        memory_mb = [getattr(pair, way).peak_rss_mb for pair in there]
        axes.plot(iterations, memory_mb, marker="o", color=color, label=way)
    axes.set_xlabel("iterations")
    axes.set_ylabel("peak RSS, MB")
    axes.set_title("Memory of the process with the nets")


if __name__ == "__main__":
    sys.exit(app())
