"""``mavbridge imagine``: from a recorded flight and the settings to the files of a rollout."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

import policy
from mavbridge.commands.config import ImagineConfig
from mavbridge.commands.imagine.loop import (
    Decider,
    PolicyDecider,
    RolloutError,
    RolloutPlan,
    RolloutStart,
    Sampler,
    WorldModelDecider,
    require_terms,
    rollout,
    torch_threads,
)
from mavbridge.commands.imagine.output import StreamedOutput, prepare_out
from mavbridge.commands.output import print_warnings, progress_bar, text_console
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.records import ImageArray
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals
from mavbridge.flight.policies import load_configured_policy
from mavbridge.recording.flight_folder import RecordedFlight, open_flight
from mavbridge.simulation.clock import SteppedClock
from policy.checkpoints.networks import load_world_model
from policy.engines.runner import require_device
from policy.errors import Warned
from policy.nets.world_model.config import WorldModelConfig
from policy.preprocess import resize

MAX_STATE_AGE_NS = 100_000_000
"""Oldest state, at the exposure of a frame, that still belongs to it."""
SHIPPED = Path(policy.__file__).parent / "weights" / "world_model.safetensors"


def imagine(config: ImagineConfig) -> int:
    """Imagine a flight; if interrupted, return 130 and keep the output so far."""
    console = text_console(stderr=True)
    plan = RolloutPlan(
        iterations=config.n_iter,
        frames=config.frames or config.exe_steps,
        exe_steps=config.exe_steps,
        seed=config.policy.seed,
    )
    prepare_out(config.out)
    flight = open_flight(config.start)
    print_warnings(console, flight.damage)
    require_device(config.policy.device)
    model = load_world_model(config.world_model or SHIPPED)
    model.config.schedule.ddim_steps(config.ddim_steps)  # raises if that number is not possible
    model = model.to(torch.device(config.policy.device)).eval()
    if plan.frames > model.config.frames:
        flag = "--frames" if config.frames else "--exe-steps"
        raise UserError(
            f"{flag} {plan.frames} is more than the {model.config.frames} that the world model "
            "imagines: lower it"
        )
    start = read_start(flight, model.config, config.start_at)
    sampler = Sampler(model, ddim_steps=config.ddim_steps)
    # Leave one core for the decoder: torch's threads spin at the end of every operation until the
    # last of them is done.
    free = torch.get_num_threads() - 1
    with ExitStack() as stack:
        clock = SteppedClock(start.newest_ns)
        decider = _make_decider(config, sampler, clock, console, stack)
        stack.enter_context(torch_threads(free))
        output = StreamedOutput(config.out, sampler, plan, decode_video=config.decode_video)
        stack.callback(output.close)
        was_stopped = run_rollout(sampler, decider, start, plan, output, console)
    lines = [f"{config.out}: {output.frames} frames", f"sha256 of the frames: {output.sha256}"]
    if not config.decode_video:
        lines = [f"{config.out.with_suffix('.parquet')}: {output.frames} rows, no video"]
    for line in lines:
        text_console().print(line, soft_wrap=True)
    if was_stopped:
        console.print("interrupted: the files hold what was imagined so far", style="yellow")
    return INTERRUPTED if was_stopped else 0


def run_rollout(
    sampler: Sampler,
    decider: Decider,
    start: RolloutStart,
    plan: RolloutPlan,
    output: StreamedOutput,
    console: Console,
) -> bool:
    """Run the iterations; return True if a signal ended them early. Raises RolloutError."""
    done = 0
    try:
        with stop_on_signals() as stop, progress_bar(console) as bar:
            task = bar.add_task("imagining", total=plan.iterations * plan.frames, status="")

            def refresh() -> None:
                status = f"iteration {done}/{plan.iterations}"
                bar.update(task, completed=output.frames, status=status)

            for segment in rollout(sampler, decider, start, plan):
                output.put(segment)
                done = segment.iteration + 1
                refresh()
                if stop.is_set():
                    break
            output.finish(refresh)
            refresh()
            return stop.is_set() and done < plan.iterations
    except MavbridgeError as error:
        output.close()  # what it wrote can then be read
        files = (output.out, output.out.with_suffix(".arrows"))
        made = " and ".join(str(file) for file in files if file.exists())
        left = f"what was written before is readable in {made}" if made else "nothing was written"
        raise RolloutError(f"{error}; {left}") from error


def _make_decider(
    config: ImagineConfig, sampler: Sampler, clock: Clock, console: Console, stack: ExitStack
) -> Decider:
    if config.decider == "world-model":
        return WorldModelDecider(sampler, from_pixels=not config.fast_policy_no_decode)
    loaded = stack.enter_context(load_configured_policy(config.policy, clock))
    for note in loaded.notes:
        console.print(note, style="yellow" if isinstance(note, Warned) else "dim")
    return PolicyDecider(loaded.runner, sampler, clock)


def read_start(flight: RecordedFlight, config: WorldModelConfig, start_s: float) -> RolloutStart:
    """Read the context from ``start_s`` after the first state; raise UserError, DatasetError."""
    what, contract = f"--start {flight.folder}", flight.meta.contract
    if contract.action != "sticks":
        raise UserError(f"{what} was flown by {contract.action}, the world model takes sticks")
    require_terms(config.contract, contract, what)
    captured_ns = flight.frames["captured_ns"].to_numpy()
    ticks = flight.ticks.filter(flight.ticks["state"].is_valid())
    if not (len(captured_ns) and ticks.num_rows):
        lacks = "no state of the vehicle" if len(captured_ns) else "no frames"
        raise UserError(f"{what} holds {lacks}: name a flight that was flown")
    state_ns = ticks["attitude_ns"].to_numpy()
    with_state = captured_ns[captured_ns >= state_ns[0]]
    first_ns = int(with_state[0] if len(with_state) else captured_ns[-1] + 1)
    first_ns += round(start_s * NS_PER_S)
    dt_s = config.frame_dt_s
    wanted_ns = [first_ns + round(k * dt_s * NS_PER_S) for k in range(config.context_frames)]
    frames = [int(np.abs(captured_ns - at_ns).argmin()) for at_ns in wanted_ns]
    off_s = np.abs(captured_ns[frames] - np.array(wanted_ns)) / NS_PER_S
    if off_s.max() >= dt_s / 2:  # otherwise no image is taken twice
        raise UserError(
            f"{what} has no image within {dt_s / 2:g} s of "
            f"{start_s + off_s.argmax() * dt_s:.2f} s after its first state: choose another "
            "--start-at, or a longer flight"
        )
    newest_ns = int(captured_ns[frames[-1]])
    # The newest state known at each exposure.
    known = np.searchsorted(state_ns, captured_ns[frames], side="right") - 1
    for row, at_ns in zip(known, captured_ns[frames], strict=True):
        if (age_ns := at_ns - state_ns[row]) > MAX_STATE_AGE_NS:
            raise UserError(
                f"{what}: at {(at_ns - state_ns[0]) / NS_PER_S:.2f} s its newest "
                f"state is {age_ns / NS_PER_MS:.0f} ms old (limit {MAX_STATE_AGE_NS // NS_PER_MS} "
                "ms): choose another --start-at, or the flight of a faster policy"
            )
    rows = [row.tick for row in flight.tick_rows() if not row.tick.is_refused]
    return RolloutStart(
        images=_start_images(flight, frames, config.image_size),
        states=np.array(ticks["state"].take(known).to_pylist(), np.float32),
        newest_ns=newest_ns,
        sent=tuple((tick.sent_ns, tick.sent) for tick in rows if tick.sent_ns < newest_ns),
    )


def _start_images(flight: RecordedFlight, frames: list[int], size: int) -> NDArray[np.uint8]:
    found: dict[int, ImageArray] = {}
    for index, rgb in enumerate(flight.rgb_images()):
        if index in frames:
            found[index] = resize(rgb, size, size)
        if index >= frames[-1]:
            break
    return np.stack([found[index] for index in frames])
