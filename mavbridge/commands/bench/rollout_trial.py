"""One rollout, measured, in the process of ``rollout_process``."""

import argparse
import json
import sys
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from rich.console import Console

from mavbridge.commands.bench.rollout_results import Trial
from mavbridge.commands.imagine.deciders import WorldModelDecider
from mavbridge.commands.imagine.loop import RolloutPlan, rollout
from mavbridge.commands.imagine.run import make_output, run_rollout
from mavbridge.commands.imagine.sampling import Sampler, cores_left_free
from mavbridge.commands.imagine.start import RolloutStart
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.records import NEUTRAL, ImageArray, RolloutFrame
from policy.checkpoints.world_model_file import load_world_model
from policy.contract import QUATERNION, STATE_DIM
from policy.world_model.config import WorldModelConfig
from policy.world_model.model import WorldModel

MB = 1 << 20


def main() -> None:
    """Imagine once and write the figures."""
    args = _arguments()
    torch.manual_seed(0)
    model = WorldModel(WorldModelConfig())
    if args.world_model is not None:
        model = load_world_model(args.world_model)
    model = model.to(args.device).eval()
    # The plain way does one thing at a time: every core is for that.
    cores = nullcontext() if args.way == "serial" else cores_left_free()
    with cores, TemporaryDirectory(prefix="mavbridge-bench-") as folder:
        trial = _measure(model, args, Path(folder) / "rollout.mp4")
    args.out.write_text(json.dumps(asdict(trial)))


def _measure(model: WorldModel, args: argparse.Namespace, out: Path) -> Trial:
    clock = MonotonicClock()
    plan = RolloutPlan(
        iterations=args.iterations,
        frames=args.frames,
        exe_steps=args.exe_steps,
        ddim_steps=args.ddim_steps,
        seed=0,
    )
    start = _start(model.config)
    _warm_up(model, plan, start)
    is_serial = args.way == "serial"
    sampler = Sampler(model, ddim_steps=plan.ddim_steps, decode_all=is_serial, clock=clock)
    decider = WorldModelDecider(sampler, from_pixels=False)
    writer_rss_mb: list[float | None] = []

    def on_frame(frame: RolloutFrame, rgb: ImageArray | None) -> None:
        is_last = frame.number + 1 == plan.iterations * plan.frames
        if is_last and output.writer_pid is not None:  # it is still there
            writer_rss_mb.append(_peak_rss_mb(output.writer_pid))

    before_ns = clock.now_ns()
    output = make_output(
        out,
        sampler,
        plan,
        serial=is_serial,
        decode_video=True,
        clock=clock,
        on_frame=on_frame,
    )
    start_ns = clock.now_ns()
    run_rollout(sampler, decider, start, plan, output, out, Console(file=sys.stderr))
    end_ns = clock.now_ns()
    on_gpu = args.device != "cpu"
    return Trial(
        way=args.way,
        device=args.device,
        iterations=plan.iterations,
        ddim_steps=plan.ddim_steps,
        torch_threads=torch.get_num_threads(),
        frames=output.frames,
        frames_decoded=sampler.meter.frames_decoded + output.frames_decoded,
        wall_s=(end_ns - start_ns) / NS_PER_S,
        start_s=(start_ns - before_ns) / NS_PER_S,
        sample_s=sampler.meter.sample.seconds,
        decode_s=sampler.meter.decode.seconds,
        write_s=sampler.meter.write.seconds,
        peak_rss_mb=_peak_rss_mb("self") or 0.0,
        writer_rss_mb=writer_rss_mb[-1] if writer_rss_mb else None,
        peak_gpu_mb=torch.cuda.max_memory_allocated() / MB if on_gpu else None,
        sha256=output.sha256,
    )


def _warm_up(model: WorldModel, plan: RolloutPlan, start: RolloutStart) -> None:
    """First calls choose and build kernels."""
    once = RolloutPlan(
        iterations=1, frames=plan.frames, exe_steps=1, ddim_steps=plan.ddim_steps, seed=0
    )
    sampler = Sampler(model, ddim_steps=1, decode_all=True, clock=MonotonicClock())
    for _ in rollout(sampler, WorldModelDecider(sampler, from_pixels=False), start, once):
        pass


def _start(config: WorldModelConfig) -> RolloutStart:
    """A picture of nothing, level and still: what is measured does not depend on it."""
    size, count = config.image_size, config.context_frames
    ramp = np.linspace(0, 255, size, dtype=np.float32).astype(np.uint8)
    image = np.broadcast_to(ramp[:, None, None], (size, size, 3))
    state = np.zeros(STATE_DIM, np.float32)
    state[QUATERNION.start] = 1.0
    return RolloutStart(
        images=np.stack([image] * count),
        states=np.stack([state] * count),
        newest_ns=0,
        sent=((-1, NEUTRAL),),
    )


def _peak_rss_mb(pid: int | str) -> float | None:
    """Not ``ru_maxrss``, which a process inherits from the one that started it; None: not known."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return None
    peaks = (int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
    return next(peaks, None)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser("mavbridge.commands.bench.rollout_process")
    parser.add_argument("--way", choices=("serial", "streamed"), required=True)
    parser.add_argument("--device", default="cpu")
    for name in ("iterations", "ddim-steps", "frames", "exe-steps"):
        parser.add_argument(f"--{name}", type=int, required=True)
    parser.add_argument("--world-model", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    return parser.parse_args()
