"""One measured rollout, in the process that ``benchmarks.rollout`` starts.

It is started with ``python -c``, because a main module is imported again by the writer process,
which is spawned and would take torch into its memory and its start.
"""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
import torch
from cyclopts import App, Parameter
from rich.console import Console

from benchmarks.results import to_json
from benchmarks.serial_rollout import SerialOutput
from mavbridge.commands.imagine.inputs import RolloutStart, Sampler, torch_threads
from mavbridge.commands.imagine.loop import RolloutPlan, WorldModelDecider
from mavbridge.commands.imagine.output import StreamedOutput
from mavbridge.commands.imagine.run import load_model, run_rollout
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.records import ImageArray, RolloutFrame
from mavbridge.core.vehicle import NEUTRAL
from policy.contract import ACTION_DIM, QUATERNION, STATE_DIM
from policy.world_model.config import WorldModelConfig

COMMAND = "from benchmarks.rollout_process import app; app()"
app = App(help=__doc__)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RolloutJob:
    """One rollout."""

    way: Literal["serial", "streamed"]
    """serial: decode everything at once, write everything at the end. streamed: as ``mavbridge
    imagine`` does it."""
    iterations: int
    ddim_steps: int
    device: str = "cpu"
    world_model: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One measured rollout; None = not measured."""

    way: str
    device: str
    iterations: int
    ddim_steps: int
    torch_threads: int
    """The serial form takes every core, the streamed one leaves one for the decoder."""
    frames: int
    frames_decoded: int
    wall_s: float
    """From the first decision to closed files."""
    start_s: float
    sample_s: float
    """The loop's thread inside the world model."""
    decode_s: float
    """The loop's thread waiting for pixels, or for room in the decode queue."""
    write_s: float
    """The loop's thread waiting for the files."""
    peak_rss_mb: float | None
    """Process with the networks."""
    writer_rss_mb: float | None
    sha256: str


@app.default
def main(job: RolloutJob, *, out: Path) -> None:
    """Imagine once and write the ``Trial`` as JSON."""
    threads = torch.get_num_threads() - (job.way == "streamed")
    with torch_threads(threads), TemporaryDirectory() as name:
        out.write_text(to_json(measure(job, Path(name) / "rollout.mp4")))


def measure(job: RolloutJob, video: Path) -> Trial:
    """Imagine once, as ``mavbridge imagine --frames 16 --fast-policy-no-decode``."""
    clock = MonotonicClock()
    plan = RolloutPlan(
        iterations=job.iterations, frames=16, exe_steps=1, ddim_steps=job.ddim_steps, seed=0
    )
    sampler = make_sampler(job)
    start, decider = still_start(sampler.config), WorldModelDecider(sampler, from_pixels=False)
    writer_rss_mb: float | None = None

    def on_frame(frame: RolloutFrame, rgb: ImageArray) -> None:
        nonlocal writer_rss_mb
        if frame.number + 1 == plan.iterations * plan.frames and output.writer_pid is not None:
            writer_rss_mb = peak_rss_mb(output.writer_pid)  # the writer still runs

    before_ns = clock.now_ns()
    output = (SerialOutput if job.way == "serial" else StreamedOutput)(
        video, sampler, plan, on_frame=on_frame
    )
    start_ns = clock.now_ns()
    run_rollout(sampler, decider, start, plan, output, Console(stderr=True))
    end_ns = clock.now_ns()
    return Trial(
        way=job.way,
        device=job.device,
        iterations=job.iterations,
        ddim_steps=job.ddim_steps,
        torch_threads=torch.get_num_threads(),
        frames=output.frames,
        frames_decoded=sampler.meter.frames_decoded + output.frames_decoded,
        wall_s=(end_ns - start_ns) / NS_PER_S,
        start_s=(start_ns - before_ns) / NS_PER_S,
        sample_s=sampler.meter.sample.seconds,
        decode_s=sampler.meter.decode.seconds,
        write_s=sampler.meter.write.seconds,
        peak_rss_mb=peak_rss_mb("self"),
        writer_rss_mb=writer_rss_mb,
        sha256=output.sha256,
    )


def make_sampler(job: RolloutJob) -> Sampler:
    """A sampler of the job's world model whose first call, which builds kernels, is behind it."""
    model = load_model(job.world_model, ddim_steps=job.ddim_steps, device=job.device)
    once = Sampler(model, ddim_steps=1, decode_all=True, clock=MonotonicClock())
    start = still_start(model.config)
    past = once.encode(start.images)[None]
    once.sample(
        past, start.states[None], np.zeros((model.config.frames, ACTION_DIM), np.float32), seed=0
    )
    decode_all = job.way == "serial"
    clock = MonotonicClock()
    return Sampler(model, ddim_steps=job.ddim_steps, decode_all=decode_all, clock=clock)


def still_start(config: WorldModelConfig) -> RolloutStart:
    """A ramp of greys, level and still: the time that a rollout takes does not depend on it."""
    size, count = config.image_size, config.context_frames
    ramp = np.linspace(0, 255, size, dtype=np.float32).astype(np.uint8)
    images = np.broadcast_to(ramp[None, :, None, None], (count, size, size, 3)).copy()
    states = np.zeros((count, STATE_DIM), np.float32)
    states[:, QUATERNION.start] = 1.0
    return RolloutStart(images=images, states=states, newest_ns=0, sent=((-1, NEUTRAL),))


def peak_rss_mb(pid: int | str) -> float | None:
    """Peak memory of a process; not ``ru_maxrss``, which is inherited from the parent."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return None
    peaks = (int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
    return next(peaks, None)
