"""The whole of ``mavbridge imagine``."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch
from rich.console import Console
from rich.text import Text

import policy
from mavbridge.commands.imagine.collected import CollectedOutput
from mavbridge.commands.imagine.deciders import Decider, PolicyDecider, WorldModelDecider
from mavbridge.commands.imagine.files import RolloutError, prepare_out
from mavbridge.commands.imagine.loop import rollout
from mavbridge.commands.imagine.output import OnFrame, Output, ignore
from mavbridge.commands.imagine.plan import RolloutPlan
from mavbridge.commands.imagine.progress import RolloutProgress
from mavbridge.commands.imagine.sampling import Sampler, cores_left_free
from mavbridge.commands.imagine.start import RealFrames, Start, read_start
from mavbridge.commands.imagine.streamed import StreamedOutput
from mavbridge.config.imagine import ImagineConfig
from mavbridge.core.clock import Clock, MonotonicClock
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals
from mavbridge.flight.policies import load_configured_policy
from mavbridge.recording.flight_folder import RecordedFlight, open_flight
from policy.checkpoints.world_model_file import load_world_model
from policy.world_model.model import WorldModel

SHIPPED = Path(policy.__file__).parent / "weights" / "world_model.safetensors"


def imagine(config: ImagineConfig) -> int:
    """Imagine as the config says; 130 if interrupted, with what there was by then.

    Raises:
        MavbridgeError, PolicyError: for whatever a person can have caused.
    """
    console = Console(stderr=True, highlight=False, emoji=False)
    clock = MonotonicClock()
    plan = RolloutPlan(
        iterations=config.n_iter,
        frames=config.frames,
        exe_steps=config.exe_steps,
        ddim_steps=config.ddim_steps,
        seed=config.policy.seed,
    )
    prepare_out(config.out)
    flight = open_flight(config.start)
    model = load_model(config.world_model, ddim_steps=plan.ddim_steps, device=config.policy.device)
    _require_frames(plan, model)
    start = read_start(flight, model.config, config.start_at)
    sampler = Sampler(model, ddim_steps=plan.ddim_steps, decode_all=config.serial, clock=clock)
    decider = _decider(config, sampler, clock, console)
    # Serially, too: how a sum is split up decides how it is rounded.
    with cores_left_free(), _onlooker(config, flight, sampler, start) as on_frame:
        output = make_output(
            config.out,
            sampler,
            plan,
            serial=config.serial,
            decode_video=config.decode_video,
            clock=clock,
            on_frame=on_frame,
        )
        was_stopped = run_rollout(sampler, decider, start, plan, output, config.out, console)
    _print(config, plan, sampler, output)
    if was_stopped:
        console.print(Text("interrupted: the files hold what was imagined so far", style="yellow"))
    return INTERRUPTED if was_stopped else 0


def make_output(
    out: Path,
    sampler: Sampler,
    plan: RolloutPlan,
    *,
    serial: bool,
    decode_video: bool,
    clock: Clock,
    on_frame: OnFrame = ignore,
) -> Output:
    """Ours, or the plain form.

    Raises:
        MavbridgeError: the files cannot be made.
    """
    kind = CollectedOutput if serial else StreamedOutput
    return kind(out, sampler, plan, decode_video=decode_video, clock=clock, on_frame=on_frame)


def run_rollout(
    sampler: Sampler,
    decider: Decider,
    start: Start,
    plan: RolloutPlan,
    output: Output,
    out: Path,
    console: Console,
) -> bool:
    """Every iteration, until somebody says stop; whether somebody did.

    Raises:
        RolloutError: it could not go on; says what is left.
        PolicyError: a net failed.
    """
    try:
        with stop_on_signals() as stop, RolloutProgress(console, plan, output) as progress:
            for segment in rollout(sampler, decider, start, plan):
                output.put(segment)
                progress.iterations = segment.iteration + 1
                progress.refresh()
                if stop.is_set():
                    break
            output.finish(progress.refresh)
            return stop.is_set() and progress.iterations < plan.iterations
    except MavbridgeError as error:
        output.close()
        left = "nothing was written"
        if out.exists() or out.with_suffix(".arrows").exists():
            left = f"{out} and its rows hold what was written before, and are readable"
        raise RolloutError(f"{error}; {left}") from error
    except BaseException:
        output.close()
        raise


def load_model(world_model: Path | None, *, ddim_steps: int, device: str) -> WorldModel:
    """A world model on its device.

    Args:
        world_model: weights; None = those that come with mavbridge.
        ddim_steps: that it will be asked for.
        device: of torch.

    Raises:
        UserError: none comes with mavbridge, or there is no such device.
        PolicyError: the weights cannot be used, or not with so many steps.
    """
    path = world_model or SHIPPED
    if world_model is None and not path.exists():
        raise UserError(
            f"no world model comes with this build ({path} is not there): give --world-model FILE"
        )
    model = load_world_model(path)
    model.config.schedule.ddim_steps(ddim_steps)  # refuses what it cannot do
    try:
        return model.to(torch.device(device)).eval()
    except (RuntimeError, AssertionError) as error:
        raise UserError(
            f"--device {device} is not available: {str(error).splitlines()[0]}"
        ) from error


def _require_frames(plan: RolloutPlan, model: WorldModel) -> None:
    if plan.frames > model.config.frames:
        raise UserError(
            f"--frames {plan.frames} is more than the {model.config.frames} that the world model "
            "imagines: lower it"
        )


def _decider(config: ImagineConfig, sampler: Sampler, clock: Clock, console: Console) -> Decider:
    if config.decider == "world-model":
        if config.policy.checkpoint is not None:
            raise UserError(
                f"--checkpoint {config.policy.checkpoint} is of a policy, and the world model "
                "decides: add --decider toge, or leave it out"
            )
        return WorldModelDecider(sampler, from_pixels=not config.fast_policy_no_decode)
    # One image, one chunk, as in flight; warm starts are for a policy that is asked 100 times a s.
    loaded = load_configured_policy(replace(config.policy, dual_rate=True, head_steps=None), clock)
    for note in loaded.notes:
        console.print(Text(note, style="yellow" if note.startswith("warning") else "dim"))
    return PolicyDecider(loaded.executable, sampler)


@contextmanager
def _onlooker(
    config: ImagineConfig, flight: RecordedFlight, sampler: Sampler, start: Start
) -> Iterator[OnFrame]:
    """The viewer, if one was asked for."""
    if config.rerun == "off":
        yield ignore
        return
    from mavbridge.observe.rerun_rollout import RolloutView

    real = RealFrames(flight, sampler.config, start.newest_ns)
    view = RolloutView(config.rerun, real=real.at)
    try:
        yield view.show
    finally:
        view.close()


def _print(config: ImagineConfig, plan: RolloutPlan, sampler: Sampler, output: Output) -> None:
    console = Console(highlight=False)
    meter = sampler.meter
    decoded = meter.frames_decoded + output.frames_decoded
    what = f"{config.out}: {output.frames} frames"
    if not config.decode_video:
        what = f"{config.out.with_suffix('.parquet')}: {output.frames} rows, no video"
    console.print(
        f"{what}, {decoded} decoded; sampling {meter.sample.seconds:.2f} s, waiting for pixels "
        f"{meter.decode.seconds:.2f} s, for the files {meter.write.seconds:.2f} s",
        soft_wrap=True,
    )
    if config.decode_video:
        console.print(f"sha256 of the frames: {output.sha256}", soft_wrap=True)
