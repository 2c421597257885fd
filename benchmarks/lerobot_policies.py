"""LeRobot policies on our engines, and beside LeRobot's own code on the same weights and inputs.

    python -m benchmarks.lerobot_policies DIR... [--steps 4] [--peer PYTHON_OF_LEROBOT]

DIR holds a checkpoint and its mavbridge.toml; ``benchmarks/lerobot_peer.py make`` makes one with
random weights. Milliseconds of one thread, the best and the median of four seconds. The peer's are
of a whole chunk: it encodes the images of all observations each time, where we encode one.
"""

import argparse
import json
import statistics
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from policy.adapters.lerobot.plan import read_plan
from policy.adapters.lerobot.policy import LeRobotDiffusion, LeRobotPolicy, load_policy_of
from policy.contract import FloatArray
from policy.engines.openvino_compile import precisions
from policy.engines.openvino_modules import ModuleConverter, make_module_runner
from policy.engines.parity import make_parity_samples
from policy.engines.runner import (
    ExecutionSettings,
    Precision,
    encode_all,
    level_state,
)
from policy.engines.torch_eager import make_torch_runner
from policy.protocol import PolicyRunner

PEER = Path(__file__).with_name("lerobot_peer.py")
TRIAL_NS = 4 * NS_PER_S
Milliseconds = tuple[float, float]
"""The best and the median of a trial."""


def main() -> None:
    """Print a table for each checkpoint."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR")
    parser.add_argument("--steps", type=int, default=4, help="DDIM steps")
    parser.add_argument("--peer", help="the Python of LeRobot's environment")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for folder in arguments.folders:
        print("\n".join(rows(folder, arguments.steps, arguments.peer)), flush=True)  # noqa: T201


def rows(folder: Path, steps: int, peer: str | None) -> list[str]:
    """Lines of a table: each engine, then LeRobot."""
    policy, notes = load_policy_of(read_plan(folder, None), seed=0, num_diffusion_steps=steps)
    settings = ExecutionSettings(name=str(folder), num_diffusion_steps=steps)
    lines = [
        *notes,
        f"{'engine':<16} {'encode best':>12} {'p50 ms':>8} {'chunk best':>12} {'p50 ms':>8}",
    ]
    for runner in _runners(policy, settings):
        lines.append(_line(runner.engine, *_times(runner)))
    if peer is not None:
        ms, furthest = _beside_lerobot(policy, folder, steps, peer)
        lines.append(_line("LeRobot, eager", None, ms))
        lines.append(f"largest difference of an action to LeRobot's: {furthest:.2g}")
    return lines


def _line(name: str, encode: Milliseconds | None, chunk: Milliseconds) -> str:
    cells = ["", ""] if encode is None else [f"{value:.2f}" for value in encode]
    cells += [f"{value:.2f}" for value in chunk]
    return "{:<16} {:>12} {:>8} {:>12} {:>8}".format(name, *cells)


def _runners(policy: LeRobotPolicy, settings: ExecutionSettings) -> list[PolicyRunner]:
    kinds: set[Precision] = {action for _, action in precisions()}
    converter = ModuleConverter(policy, settings.name)
    graphs = [make_module_runner(policy, settings, kind, kind, converter) for kind in sorted(kinds)]
    return [make_torch_runner(policy, settings), *graphs]


def _times(runner: PolicyRunner) -> tuple[Milliseconds, Milliseconds]:
    contract = runner.contract
    samples = make_parity_samples(contract)
    rgb, state, history = samples.rgb[0], samples.state[:1], samples.history[:1]
    encoded = encode_all(runner, rgb)
    image = rgb.reshape(-1, *rgb.shape[-3:])[0]
    return (
        _time(lambda: runner.encode(image)),
        _time(lambda: runner.act(encoded, state, history)),
    )


def _time(function: Callable[[], Any]) -> Milliseconds:
    times: list[float] = []
    clock = MonotonicClock()
    end_ns = clock.now_ns() + TRIAL_NS
    while len(times) < 5 or clock.now_ns() < end_ns:
        start_ns = clock.now_ns()
        function()
        times.append((clock.now_ns() - start_ns) / NS_PER_MS)
    return min(times), statistics.median(times)


def _beside_lerobot(
    policy: LeRobotPolicy, folder: Path, steps: int, peer: str
) -> tuple[Milliseconds, float]:
    """LeRobot's milliseconds, and the largest difference of its chunk to ours on torch.

    For contract files that keep the order and the units of LeRobot's state, action and cameras.
    """
    contract = policy.contract
    noise = torch.zeros(0)
    if isinstance(policy, LeRobotDiffusion):
        noise = policy.initial_noise
    random = np.random.default_rng(0)
    shape = (contract.observation_steps, len(contract.cameras), *contract.image_shape[-3:])
    images: FloatArray = random.random(shape, np.float32)
    state = np.tile(level_state(contract).reshape(-1, contract.state_dim)[:1], (shape[0], 1))
    with tempfile.TemporaryDirectory() as scratch:
        inputs = Path(scratch) / "inputs.npz"
        np.savez(inputs, state=state, images=images, noise=noise.numpy())
        command = [peer, str(PEER), "time", str(folder), str(inputs), str(steps)]
        answer = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, timeout=600)
    found: dict[str, Any] = json.loads(answer.stdout.strip().splitlines()[-1])
    history = torch.zeros(1, contract.history_len, 4)
    with torch.inference_mode():
        ours = policy.predict(
            torch.from_numpy(images)[None],
            torch.from_numpy(state.reshape(1, *contract.state_shape)),
            history,
            steps,
        )
    best, median = found["ms"]
    return (best, median), float(np.abs(ours[0].numpy() - np.array(found["chunk"])).max())


if __name__ == "__main__":
    main()
