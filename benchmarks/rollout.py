"""Imagined flights: the plain serial way beside the streamed one.

python -m benchmarks.rollout --json rollout.json --plot rollout.png
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from cyclopts import App
from rich.console import Console

from benchmarks.results import from_json, this_machine
from benchmarks.rollout_process import COMMAND, RolloutJob, Trial
from mavbridge.commands.imagine.run import load_model
from mavbridge.commands.output import (
    BLUE,
    FIGURE_DPI,
    FIGURE_STYLE,
    GREY,
    RED,
    make_table,
    number,
    print_status,
    require_outputs,
    table_console,
)
from mavbridge.core.processes import running, wait

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TIMEOUT_S = 3600.0
STEPS, ITERATIONS = 4, 8
"""DDIM steps where iterations vary, and iterations where steps vary."""
FULL = ((8, 64, 256), (1, 2, 4, 8, 16, 32, 50), 3)
QUICK = ((2, 8), (1, 4), 1)
"""Iterations, DDIM steps, and repeats, of which the median by wall time counts."""
app = App(help=__doc__)


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


@app.default
def main(
    *,
    quick: bool = False,
    json: Path | None = None,
    plot: Path | None = None,
    world_model: Path | None = None,
    device: str = "cpu",
) -> int:
    """Measure; 1 if the two ways do not give the same frames.

    Args:
        quick: short rollouts, to look at and not to quote.
        json: where to write all figures.
        plot: where to draw them as PNG.
        world_model: weights; by default those that come with mavbridge.
        device: torch device of the world model.
    """
    require_outputs(json, plot)
    load_model(world_model, ddim_steps=STEPS, device=device)  # refused before the first process
    iterations, steps, repeats = QUICK if quick else FULL
    default = RolloutJob(way="serial", iterations=ITERATIONS, ddim_steps=STEPS)
    job = replace(default, device=device, world_model=world_model)
    by_iterations = [measure(replace(job, iterations=count), repeats) for count in iterations]
    by_steps = [measure(replace(job, ddim_steps=count), repeats) for count in steps]
    pairs = [*by_iterations, *by_steps]
    print_pairs(pairs, table_console())
    if json is not None:
        write_json(pairs, json)
    if plot is not None:
        draw(by_iterations, by_steps).savefig(plot)
    return 0 if all(pair.serial.sha256 == pair.streamed.sha256 for pair in pairs) else 1


def measure(job: RolloutJob, repeats: int) -> Pair:
    """Run both ways in turn, so that a machine that changes meanwhile does to both."""
    print_status(f"{job.iterations} iterations of {job.ddim_steps} steps, both ways")
    pairs = [(run_trial(job), run_trial(replace(job, way="streamed"))) for _ in range(repeats)]
    serial, streamed = zip(*pairs, strict=True)
    return Pair(serial=median_trial(serial), streamed=median_trial(streamed))


def run_trial(job: RolloutJob) -> Trial:
    """One rollout in a process of its own.

    Raises:
        UserError: it failed; quotes the end of its log.
    """
    with TemporaryDirectory(prefix="mavbridge-bench-") as name:
        out, log = Path(name) / "trial.json", Path(name) / "trial.log"
        given = {key: value for key, value in asdict(job).items() if value is not None}
        flags = [f"--{key.replace('_', '-')}={value}" for key, value in given.items()]
        with running(sys.executable, "-c", COMMAND, f"--out={out}", *flags, log=log) as process:
            wait(process, f"the {job.way} rollout", log, TIMEOUT_S)
        return from_json(Trial, out.read_text())


def median_trial(trials: Sequence[Trial]) -> Trial:
    """The trial whose wall time is the median (the lower one of two)."""
    return sorted(trials, key=lambda trial: trial.wall_s)[(len(trials) - 1) // 2]


def print_pairs(pairs: Sequence[Pair], console: Console) -> None:
    """Print two rows for each pair."""
    header = (
        *("way", "iterations", "steps", "decoded", "wall", "sampling"),
        *("pixels", "files", "nets", "writer", "speed-up", "bound"),
    )
    rows = [
        (
            *(one.way, str(one.iterations), str(one.ddim_steps)),
            *(str(one.frames_decoded), number(one.wall_s, 2), number(one.sample_s, 2)),
            *(number(one.decode_s, 2), number(one.write_s, 2)),
            *(number(one.peak_rss_mb, 0), number(one.writer_rss_mb, 0)),
            *(number(pair.speed_up, 2), number(pair.bound, 2)),
        )
        for pair in pairs
        for one in (pair.serial, pair.streamed)
    ]
    title = "Rollouts: time with waits for pixels and files, s; peak memory of processes, MB"
    console.print(make_table(title, header, rows))
    different = [pair for pair in pairs if pair.serial.sha256 != pair.streamed.sha256]
    console.print(f"{len(different)} of {len(pairs)} pairs differ in their frames")


def write_json(pairs: Sequence[Pair], path: Path) -> None:
    """Write all figures; null = not measured."""
    rows = [asdict(pair) | {"speed_up": pair.speed_up, "bound": pair.bound} for pair in pairs]
    document = {"machine": asdict(this_machine()), "pairs": rows}
    path.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n")


def draw(by_iterations: Sequence[Pair], by_steps: Sequence[Pair]) -> "Figure":
    """Plots, left to right: speed-up by steps, memory by iterations."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(FIGURE_STYLE | {"axes.grid.axis": "y"}):
        figure = Figure(figsize=(11.0, 4.4), dpi=FIGURE_DPI, facecolor="white")
        left, right = figure.subplots(1, 2)
        steps = [pair.serial.ddim_steps for pair in by_steps]
        left.plot(steps, [one.speed_up for one in by_steps], "o-", color=BLUE, label="measured")
        left.plot(steps, [one.bound for one in by_steps], color=RED, label="Amdahl's bound")
        left.set(xlabel="DDIM steps of a sample", title="Speed-up over the serial path")
        iterations = [pair.serial.iterations for pair in by_iterations]
        for way, color in (("serial", GREY), ("streamed", BLUE)):
            memory_mb = [getattr(pair, way).peak_rss_mb for pair in by_iterations]
            right.plot(iterations, memory_mb, "o-", color=color, label=way)
        right.set(xlabel="iterations", ylabel="peak RSS, MB")
        right.set_title("Memory of the process with the networks")
        for axes, values in ((left, steps), (right, iterations)):
            axes.set_xscale("log", base=2)
            axes.set_xticks(values, [str(value) for value in values])
            axes.minorticks_off()
            axes.set_ylim(0, 1.2 * axes.get_ylim()[1])
            axes.legend(loc="best")
        figure.tight_layout(w_pad=3)
    return figure


if __name__ == "__main__":
    sys.exit(app())
