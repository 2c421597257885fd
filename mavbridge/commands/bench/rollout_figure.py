"""A benchmark of rollouts as one picture: speed-up by steps, memory by iterations."""

from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from mavbridge.commands.bench.figure import ACCENT, DOTS_PER_INCH, MUTED, OURS, STYLE, THEIRS
from mavbridge.commands.bench.rollout_results import RolloutBench

SIZE_INCHES = (11.0, 4.4)


def draw(result: RolloutBench, path: Path) -> None:
    """Write the PNG."""
    with rc_context(STYLE | {"axes.grid.axis": "y"}):
        figure = Figure(figsize=SIZE_INCHES, dpi=DOTS_PER_INCH, facecolor="white")
        left, right = figure.subplots(1, 2)
        _draw_speed_up(left, result)
        _draw_memory(right, result)
        here = result.machine
        figure.text(
            *(0.012, 0.015),
            f"{here.cpu}, cores: {here.cores}; "
            f"{result.world_model}, {result.frames} frames an iteration",
            color=MUTED,
            fontsize=8.5,
        )
        figure.tight_layout(rect=(0, 0.05, 1, 1), w_pad=3)
        figure.savefig(path)


def _draw_speed_up(axes: Axes, result: RolloutBench) -> None:
    for device, style in (("cpu", "-"), ("cuda", "--")):
        pairs = [pair for pair in result.by_steps if pair.serial.device == device]
        if not pairs:
            continue
        steps = [pair.serial.ddim_steps for pair in pairs]
        axes.plot(
            steps,
            [pair.speed_up for pair in pairs],
            style,
            marker="o",
            color=OURS[1],
            label=f"measured, {device}",
        )
        axes.plot(
            steps,
            [pair.bound for pair in pairs],
            style,
            color=ACCENT,
            label=f"Amdahl's bound, {device}",
        )
    axes.axhline(1.0, color=MUTED, linewidth=0.8)
    _mark(axes, [pair.serial.ddim_steps for pair in result.by_steps])
    axes.set_xlabel("DDIM steps of a sample")
    axes.set_ylim(bottom=0)
    axes.set_title("Speed-up over the serial path")
    axes.legend(loc="best")


def _draw_memory(axes: Axes, result: RolloutBench) -> None:
    pairs = [pair for pair in result.by_iterations if pair.serial.device == "cpu"]
    iterations = [pair.serial.iterations for pair in pairs]
    axes.plot(
        iterations,
        [pair.serial.peak_rss_mb for pair in pairs],
        marker="o",
        color=THEIRS,
        label="serial",
    )
    axes.plot(
        iterations,
        [pair.streamed.peak_rss_mb for pair in pairs],
        marker="o",
        color=OURS[1],
        label="ours",
    )
    _mark(axes, iterations)
    axes.set_xlabel("iterations")
    axes.set_ylabel("peak RSS, MB")
    axes.set_ylim(bottom=0, top=1.2 * axes.get_ylim()[1])
    axes.set_title("Memory of the process with the nets")
    axes.legend(loc="lower right")


def _mark(axes: Axes, measured: list[int]) -> None:
    """What was measured, and nothing else, on a logarithmic axis."""
    axes.set_xscale("log", base=2)
    axes.set_xticks(sorted(set(measured)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.minorticks_off()
