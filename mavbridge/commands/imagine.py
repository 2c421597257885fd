"""``mavbridge imagine``: from a recorded flight and the settings to the files of a rollout.

    start (a flight) --> ObservationQueue --> Decider --16 actions--> world model --16 latent frames
                              ^                                              |          and states
                              '--- exe_steps of them; pixels if needed ------+
                                                                             v  bounded queue
                           rollout.mp4 <-- writer process <-- decode thread (or CUDA side stream)
                           rollout.parquet

``imagine_rollout.rollout`` is the loop and does not use files. ``StreamedOutput`` writes its
segments as they come. Only the files grow with the number of iterations. Until it is
whole, the table is ``NAME.arrows``, as with recorded flights.
"""

import hashlib
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from pathlib import Path
from threading import Event

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor

import policy
from mavbridge.commands.config import ImagineConfig
from mavbridge.commands.imagine_rollout import (
    Decider,
    PolicyDecider,
    RolloutError,
    RolloutPlan,
    RolloutStart,
    Sampler,
    Segment,
    WorldModelDecider,
    require_terms,
    rollout,
)
from mavbridge.commands.output import print_warnings, progress_bar, text_console
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.files import require_writable
from mavbridge.core.records import ImageArray
from mavbridge.core.stopping import INTERRUPTED, HungError, stop_on_signals
from mavbridge.flight.policies import load_configured_policy
from mavbridge.recording.flight_folder import RecordedFlight, open_flight
from mavbridge.recording.tables import TableWriter
from mavbridge.recording.video_process import WRITE_ERRORS, VideoJob
from mavbridge.recording.video_writer import VideoWriter
from mavbridge.simulation.clock import SteppedClock
from policy.checkpoints.networks import load_world_model
from policy.contract import ACTION_DIM, STATE_DIM
from policy.engines.runner import require_device
from policy.engines.torch_engines import torch_threads
from policy.errors import Warned
from policy.nets.world_model.config import WorldModelConfig
from policy.preprocess import resize

MAX_STATE_AGE_NS = 100_000_000
"""Oldest state, at the exposure of a frame, that still belongs to it."""
SHIPPED = Path(policy.__file__).parent / "weights" / "world_model.safetensors"
SCHEMA = pa.schema(
    [
        pa.field("iteration", pa.int32(), nullable=False),
        pa.field("frame", pa.int32(), nullable=False),
        pa.field("executed", pa.bool_(), nullable=False),
        pa.field("time_s", pa.float64(), nullable=False),
        pa.field("state", pa.list_(pa.float32(), STATE_DIM), nullable=False),
        pa.field("action", pa.list_(pa.float32(), ACTION_DIM), nullable=False),
    ]
)
"""Columns described in docs/formats.md."""


def prepare_out(out: Path) -> None:
    """Raise UserError if a rollout cannot be written here."""
    if out.suffix != ".mp4":
        raise UserError(f"--out {out} must end in .mp4")
    for path in (out, out.with_suffix(".arrows"), out.with_suffix(".parquet")):
        if path.exists():
            raise UserError(f"{path} is there already: remove it, or name another --out")
    require_writable(out, "--out")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Context manager: convert errors of writing a file to ``RolloutError``."""
    try:
        yield
    except WRITE_ERRORS as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise RolloutError(f"{path} cannot be written: {reason}") from error


QUEUED_SEGMENTS = 2
"""Most segments that wait for the decoder; the loop then waits, too, so that the slowest part sets
the pace."""
STALL_S = 120.0
"""Longest time without a finished frame."""
END_S = 45.0
"""Longer than the timeout for a hung writer process."""
_POLL_S = 0.1


class StreamedOutput:
    """Writes frames and rows of segments to disk as they come. Used by the loop's thread.

    Methods other than ``close`` raise ``MavbridgeError`` if writing fails or has failed before.
    """

    def __init__(
        self, out: Path, sampler: Sampler, plan: RolloutPlan, *, decode_video: bool = True
    ) -> None:
        """Open the output at ``out``; without ``decode_video``, only the rows."""
        self.out = out
        self._plan = plan
        self._model = sampler.model
        self._frame_dt_s = sampler.config.frame_dt_s
        self._digest = hashlib.sha256()
        self.frames = 0
        self._stream: torch.cuda.Stream | None = None
        """On a GPU, the decoder's stream beside the sampler's."""
        if (device := next(sampler.model.parameters()).device).type == "cuda":
            self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        self._table_path = out.with_suffix(".arrows")
        self.video: VideoWriter | None = None
        with writing(self._table_path):
            self._table = TableWriter(out, SCHEMA)
        if decode_video:
            try:
                self.video = VideoWriter(VideoJob(out, 1 / self._frame_dt_s), pressure="offline")
            except BaseException:
                self._table.abandon()
                raise
        self._stop = Event()
        self._open: deque[Future[None]] = deque()
        """Segments that are not written yet."""
        self._thread = ThreadPoolExecutor(
            1, "mavbridge-rollout-decode", torch.set_num_threads, (1,)
        )

    @property
    def sha256(self) -> str:
        """SHA-256 of all raw frames so far, in order."""
        return self._digest.hexdigest()

    def put(self, segment: Segment) -> None:
        """Hand over a segment; wait while ``QUEUED_SEGMENTS`` are waiting."""
        ready = None
        if self.video is not None and segment.latents.is_cuda:
            ready = torch.cuda.current_stream(segment.latents.device).record_event()
        self._wait(QUEUED_SEGMENTS)
        self._open.append(self._thread.submit(self._serve, segment, ready))

    def _wait(self, most: int, on_wait: Callable[[], None] = lambda: None) -> None:
        """Wait until at most ``most`` segments are open, as long as frames are finished.

        Waits are counted, not timed: a pause of the process (Ctrl-Z) is one of them.
        """
        seen, waits = self.frames, 0
        while len(self._open) > most:
            on_wait()
            if wait([self._open[0]], _POLL_S).done:
                self._open[0].result()  # raises the thread's exception, also at the next call
                self._open.popleft()
            seen, waits = self.frames, waits + 1 if self.frames == seen else 0
            if waits * _POLL_S > STALL_S:
                raise HungError(f"no frame has been decoded and written for {STALL_S:g} s")

    def finish(self, on_wait: Callable[[], None] = lambda: None) -> None:
        """Write all segments, close the files, and compare their lengths."""
        self._wait(0, on_wait)
        if self.video is not None:
            self.video.finish()
            if self.video.written != self._table.rows:
                raise RolloutError(
                    f"{self.video.written} frames were written for {self._table.rows} rows"
                )
        with writing(self._table_path):
            self._table.finish()

    def close(self) -> None:
        """Stop the thread and the writer, if ``finish`` did not; what is written stays readable."""
        self._stop.set()
        is_hung = bool(wait(self._open, END_S).not_done)
        self._thread.shutdown(wait=not is_hung)
        if self.video is not None:
            self.video.close()
        self._table.abandon()

    def _serve(self, segment: Segment, ready: torch.cuda.Event | None) -> None:
        """Write a segment, whose latents can be read after ``ready``; none after an error."""
        try:
            if not self._stop.is_set():
                self._write(segment, ready)
        except BaseException:
            self._stop.set()
            raise

    def _write(self, segment: Segment, ready: torch.cuda.Event | None) -> None:
        plan, first_step = self._plan, segment.iteration * self._plan.exe_steps + 1
        # Rows first: after a crash, rows without a frame are possible, but no frame without a row.
        with writing(self._table_path):
            for row in range(plan.frames):
                self._table.add(
                    {
                        "iteration": segment.iteration,
                        "frame": row,
                        "executed": row < plan.exe_steps,
                        "time_s": (first_step + row) * self._frame_dt_s,
                        "state": segment.states[row],
                        "action": segment.actions[row],
                    }
                )
            self._table.flush()
        for row in range(plan.frames):
            if self._stop.is_set():
                return
            if self.video is not None:
                rgb = segment.decoded.get(row)
                if rgb is None:
                    rgb = self._decode(segment.latents[row, None], ready)
                number = segment.iteration * plan.frames + row
                # Frames of the video are evenly spaced.
                at_ns = round(number * self._frame_dt_s * NS_PER_S)
                self.video.submit(rgb, at_ns)
                self._digest.update(np.ascontiguousarray(rgb).data)
            self.frames += 1

    def _decode(self, latents: Tensor, ready: torch.cuda.Event | None) -> ImageArray:
        """Decode latents [1, C, h, w]; on a GPU they can be read after the event ``ready``."""
        beside: AbstractContextManager[object] = nullcontext()
        if self._stream is not None and ready is not None:
            self._stream.wait_event(ready)
            # Once the loop's stream frees the memory, it must not be reused before this one ends.
            latents.record_stream(self._stream)
            beside = torch.cuda.stream(self._stream)
        with torch.inference_mode(), beside:
            pixels: ImageArray = self._model.decode(latents)[0].cpu().numpy()
        return pixels


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
