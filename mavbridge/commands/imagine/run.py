"""``mavbridge imagine``: from a recorded flight and the settings to the files of a rollout."""

from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import torch
from rich.console import Console
from rich.text import Text

import policy
from mavbridge.commands.config import ImagineConfig
from mavbridge.commands.imagine.inputs import (
    RealFrames,
    RolloutStart,
    Sampler,
    read_start,
    torch_threads,
)
from mavbridge.commands.imagine.loop import (
    Decider,
    PolicyDecider,
    RolloutPlan,
    WorldModelDecider,
    rollout,
)
from mavbridge.commands.imagine.output import (
    OnFrame,
    RolloutError,
    StreamedOutput,
    ignore_frame,
    prepare_out,
)
from mavbridge.commands.output import progress_bar
from mavbridge.core.clock import Clock, MonotonicClock
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals
from mavbridge.flight.policies import load_configured_policy
from mavbridge.recording.flight_folder import open_flight
from policy.checkpoints.networks import load_world_model
from policy.engines.runner import require_devices
from policy.errors import Warned
from policy.nets.world_model.model import WorldModel

SHIPPED = Path(policy.__file__).parent / "weights" / "world_model.safetensors"


def imagine(config: ImagineConfig) -> int:
    """Imagine a flight; if interrupted, return 130 and keep the output so far."""
    console = Console(stderr=True, highlight=False, emoji=False)
    clock = MonotonicClock()
    plan = RolloutPlan(
        iterations=config.n_iter,
        frames=config.frames or config.exe_steps,
        exe_steps=config.exe_steps,
        seed=config.policy.seed,
    )
    prepare_out(config.out)
    flight = open_flight(config.start)
    for text in flight.damage:
        console.print(f"warning: {text}", soft_wrap=True)
    model = load_model(
        config.world_model, ddim_steps=config.ddim_steps, device=config.policy.device
    )
    if plan.frames > model.config.frames:
        flag = "--frames" if config.frames else "--exe-steps"
        raise UserError(
            f"{flag} {plan.frames} is more than the {model.config.frames} that the world model "
            "imagines: lower it"
        )
    start = read_start(flight, model.config, config.start_at)
    sampler = Sampler(model, ddim_steps=config.ddim_steps, clock=clock)
    # Leave one core for the decoder: torch's threads spin at the end of every operation until the
    # last of them is done.
    free = torch.get_num_threads() - 1
    with ExitStack() as stack:
        decider = _make_decider(config, sampler, clock, console, stack)
        stack.enter_context(torch_threads(free))
        on_frame: OnFrame = ignore_frame
        if config.rerun != "off":
            from mavbridge.observe.viewer.rollout import RolloutView

            real = RealFrames(flight, model.config, start.newest_ns)
            view = stack.enter_context(closing(RolloutView(config.rerun, real=real.at)))
            on_frame = view.show
        output = StreamedOutput(
            config.out, sampler, plan, decode_video=config.decode_video, on_frame=on_frame
        )
        was_stopped = run_rollout(sampler, decider, start, plan, output, console)
    _print_summary(config, sampler, output)
    if was_stopped:
        console.print(Text("interrupted: the files hold what was imagined so far", style="yellow"))
    return INTERRUPTED if was_stopped else 0


def run_rollout(
    sampler: Sampler,
    decider: Decider,
    start: RolloutStart,
    plan: RolloutPlan,
    output: StreamedOutput,
    console: Console,
) -> bool:
    """Run the iterations; return True if a signal ended them early.

    Raises:
        RolloutError: the rollout had to end; the message names the remaining files.
    """
    done = 0
    try:
        with stop_on_signals() as stop, progress_bar(console) as bar:
            task = bar.add_task("imagining", total=plan.iterations * plan.frames, status="")

            def refresh() -> None:
                status = (
                    f"iteration {done}/{plan.iterations}, to decode {output.decode_queue}, "
                    f"to write {output.writer_queue}"
                )
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
        output.close()
        left = "nothing was written"
        if output.out.exists() or output.out.with_suffix(".arrows").exists():
            left = f"{output.out} and its rows hold what was written before, and are readable"
        raise RolloutError(f"{error}; {left}") from error
    except BaseException:
        output.close()
        raise


def load_model(world_model: Path | None, *, ddim_steps: int, device: str) -> WorldModel:
    """Load a world model onto a torch device; default: the one shipped with mavbridge.

    Raises:
        PolicyError: no such device, or the weights cannot be used, or not with so many steps.
    """
    require_devices(device)
    model = load_world_model(world_model or SHIPPED)
    model.config.schedule.ddim_steps(ddim_steps)  # raises if that number is not possible
    return model.to(torch.device(device)).eval()


def _make_decider(
    config: ImagineConfig, sampler: Sampler, clock: Clock, console: Console, stack: ExitStack
) -> Decider:
    if config.decider == "world-model":
        if config.policy.checkpoint is not None:
            raise UserError(
                f"--checkpoint {config.policy.checkpoint} is of a policy, and the world model "
                "decides: add --decider toge, or leave it out"
            )
        return WorldModelDecider(sampler, from_pixels=not config.fast_policy_no_decode)
    wanted = replace(config.policy, dual_rate=True)
    loaded = stack.enter_context(load_configured_policy(wanted, clock))
    for note in loaded.notes:
        console.print(Text(note, style="yellow" if isinstance(note, Warned) else "dim"))
    return PolicyDecider(loaded.runner, sampler)


def _print_summary(config: ImagineConfig, sampler: Sampler, output: StreamedOutput) -> None:
    console = Console(highlight=False)
    seconds = sampler.seconds
    decoded = sampler.frames_decoded + output.frames_decoded
    what = f"{config.out}: {output.frames} frames"
    if not config.decode_video:
        what = f"{config.out.with_suffix('.parquet')}: {output.frames} rows, no video"
    console.print(
        f"{what}, {decoded} decoded; sampling {seconds['sample']:.2f} s, waiting for pixels "
        f"{seconds['decode']:.2f} s, for the files {seconds['write']:.2f} s",
        soft_wrap=True,
    )
    if config.decode_video:
        console.print(f"sha256 of the frames: {output.sha256}", soft_wrap=True)
