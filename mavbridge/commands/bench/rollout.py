"""``mavbridge bench rollout``: the plain serial way through a rollout against ours."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from sys import executable
from tempfile import TemporaryDirectory

import torch
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mavbridge.commands.bench.processes import running, wait
from mavbridge.commands.bench.rollout_results import (
    Comparison,
    RolloutBench,
    Trial,
    Way,
    to_json,
    trial_from_json,
    typical,
)
from mavbridge.commands.bench.run import machine, require_folder, sayer, table_console
from mavbridge.commands.bench.tables import number
from mavbridge.commands.imagine.run import SHIPPED
from mavbridge.commands.plots import needs_matplotlib
from mavbridge.config.bench import RolloutBenchConfig
from mavbridge.core.stopping import INTERRUPTED
from policy.checkpoints.world_model_file import load_world_model

FRAMES, EXE_STEPS = 16, 1
"""As ``mavbridge imagine`` has them by default."""
TIMEOUT_S = 3600.0
Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Effort:
    """What is measured."""

    iterations: tuple[int, ...]
    """With ``ddim_steps_long`` steps."""
    ddim_steps_long: int
    ddim_steps: tuple[int, ...]
    """With ``iterations_short`` iterations."""
    iterations_short: int
    repeats: int
    """Of the latter; their medians count."""


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


def bench_rollout(config: RolloutBenchConfig) -> int:
    """Run everything that the config asks for; 130 if interrupted.

    Raises:
        MavbridgeError, PolicyError: for whatever a person can have caused.
    """
    draw = None if config.plot is None else _drawing(config.plot)
    for path in (config.json, config.plot):
        if path is not None:
            require_folder(path)
    weights = config.world_model or (SHIPPED if SHIPPED.exists() else None)
    if weights is not None:
        load_world_model(weights)  # refused now, and in words
    console = table_console()
    try:
        result = measure(QUICK if config.quick else FULL, weights, config.quick, sayer())
    except KeyboardInterrupt:
        console.print("interrupted: nothing is written")
        return INTERRUPTED
    print_result(result, console)
    if config.json is not None:
        config.json.write_text(to_json(result))
    if draw is not None:
        draw(result)
    return 0


def measure(effort: Effort, weights: Path | None, is_quick: bool, say: Say) -> RolloutBench:
    """Every trial, one after the other."""
    devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    by_iterations, by_steps = [], []
    for device in devices:
        for iterations in effort.iterations:
            steps = effort.ddim_steps_long
            say(f"{iterations} iterations of {steps} steps on {device}, both ways")
            by_iterations.append(_compare(device, iterations, steps, 1, weights))
        for steps in effort.ddim_steps:
            iterations = effort.iterations_short
            say(f"{iterations} iterations of {steps} steps on {device}, both ways")
            by_steps.append(_compare(device, iterations, steps, effort.repeats, weights))
    return RolloutBench(
        machine=machine(),
        quick=is_quick,
        world_model="random weights" if weights is None else weights.name,
        frames=FRAMES,
        exe_steps=EXE_STEPS,
        by_iterations=tuple(by_iterations),
        by_steps=tuple(by_steps),
    )


def _compare(
    device: str, iterations: int, steps: int, repeats: int, weights: Path | None
) -> Comparison:
    """The two ways take turns, so that a machine that changes meanwhile does to both."""
    found: dict[Way, list[Trial]] = {"serial": [], "streamed": []}
    for _ in range(repeats):
        for way, trials in found.items():
            trials.append(_run(way, device, iterations, steps, weights))
    return Comparison(serial=typical(found["serial"]), streamed=typical(found["streamed"]))


def _run(way: Way, device: str, iterations: int, steps: int, weights: Path | None) -> Trial:
    with TemporaryDirectory(prefix="mavbridge-bench-") as name:
        out, log = Path(name) / "trial.json", Path(name) / "trial.log"
        command = [
            *(executable, "-m", "mavbridge.commands.bench.rollout_process", "--out", str(out)),
            *("--way", way, "--device", device, "--iterations", str(iterations)),
            *("--ddim-steps", str(steps), "--frames", str(FRAMES), "--exe-steps", str(EXE_STEPS)),
        ]
        if weights is not None:
            command += ["--world-model", str(weights.resolve())]
        with running(*command, log=log) as process:
            wait(process, f"the {way} rollout", log, TIMEOUT_S)
        return trial_from_json(out.read_text())


def _drawing(path: Path) -> Callable[[RolloutBench], None]:
    """What draws the figure to ``path``; looked for before the run."""
    with needs_matplotlib():
        from mavbridge.commands.bench.rollout_figure import draw
    return lambda result: draw(result, path)


def print_result(result: RolloutBench, console: Console) -> None:
    """Both tables."""
    here = result.machine
    console.print(
        Text(
            f"{here.cpu}, {here.cores} cores, torch {here.torch}; world model: "
            f"{result.world_model}; {result.frames} frames an iteration, "
            f"{result.exe_steps} executed"
        )
    )
    console.print(trial_table(result))
    console.print(steps_table(result))
    pairs = (*result.by_iterations, *result.by_steps)
    if all(pair.is_exact for pair in pairs):
        console.print(f"all {len(pairs)} pairs have the same frames, bit for bit")
    else:
        console.print(Text("the two ways did not give the same frames", style="bold red"))


def trial_table(result: RolloutBench) -> Table:
    """A row for each way and number of iterations."""
    trials = [trial for pair in result.by_iterations for trial in (pair.serial, pair.streamed)]
    has_gpu = any(trial.peak_gpu_mb is not None for trial in trials)
    table = Table(title="Where the time goes, s; peak memory, MB", title_justify="left")
    columns = [
        "way",
        "iterations",
        "threads",
        "decoded",
        "start",
        "wall",
        "sampling",
        "waits: pixels",
        "waits: files",
    ]
    columns += ["nets RSS", "writer RSS", *(("GPU", "device") if has_gpu else ())]
    for name in columns:
        table.add_column(name, justify="left" if name == "way" else "right")
    for trial in trials:
        cells = [
            *(trial.way, str(trial.iterations), str(trial.torch_threads)),
            str(trial.frames_decoded),
            *(number(trial.start_s, 2), number(trial.wall_s, 2), number(trial.sample_s, 2)),
            *(number(trial.decode_s, 2), number(trial.write_s, 2)),
            *(number(trial.peak_rss_mb, 0), number(trial.writer_rss_mb, 0)),
        ]
        if has_gpu:
            cells += [number(trial.peak_gpu_mb, 0), trial.device]
        table.add_row(*cells)
    return table


def steps_table(result: RolloutBench) -> Table:
    """A row for each number of steps."""
    table = Table(
        title=f"Speed-up by DDIM steps; bound: if all but the sampling took no time "
        f"({result.by_steps[0].serial.iterations} iterations)",
        title_justify="left",
    )
    for name in ("steps", "serial, s", "ours, s", "speed-up", "bound", "device"):
        table.add_column(name, justify="right")
    for pair in result.by_steps:
        table.add_row(
            str(pair.serial.ddim_steps),
            number(pair.serial.wall_s, 2),
            number(pair.streamed.wall_s, 2),
            number(pair.speed_up, 2),
            number(pair.bound, 2),
            pair.serial.device,
        )
    return table
