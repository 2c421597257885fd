"""Flights of LeRobot policies at the asked rates, beside what LeRobot's own code makes of a chunk.

    python -m benchmarks.lerobot_flights DIR... [--steps 4] [--peer PYTHON_OF_LEROBOT]

DIR holds a checkpoint and its mavbridge.toml; ``benchmarks/lerobot_peer.py make`` makes one with
random weights. Each flies both loops against the simulated vehicle, and its chunks are replaced by
a level climb once they are computed. LeRobot's code gets one thread, and a whole chunk includes all
images of all observations.
"""

import argparse
import json
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.flight import fly
from benchmarks.lerobot_policies import PEER
from benchmarks.results import Flight
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.errors import UserError
from mavbridge.core.vehicle import Percentiles
from policy.adapters.lerobot.plan import read_plan
from policy.contract import ACTION_DIM

CONTRACT_FILE = "mavbridge.toml"
HEAD = (
    "| policy | chunks/s, images/s | slots missed | chunk, p50 / p99 | image | LeRobot: chunk |",
    "|---|---|---|---|---|---|",
)


@dataclass(frozen=True, kw_only=True)
class Request:
    """What is asked of every policy."""

    steps: int
    action_hz: float
    flight_s: float
    peer: str | None


def main() -> None:
    """Print a table with a row for each checkpoint."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR")
    parser.add_argument("--steps", type=int, default=4, help="DDIM steps")
    parser.add_argument("--action-rate", type=float, default=100.0, help="chunks a second")
    parser.add_argument("--duration", type=float, default=60.0, help="seconds of each flight")
    parser.add_argument("--peer", help="the Python of LeRobot's environment")
    given = parser.parse_args()
    request = Request(
        steps=given.steps, action_hz=given.action_rate, flight_s=given.duration, peer=given.peer
    )
    print("\n".join(HEAD), flush=True)  # noqa: T201 - its result
    for folder in given.folders:
        print(row(folder, request), flush=True)  # noqa: T201


def row(folder: Path, request: Request) -> str:
    """One line of the table; what could not be measured says why."""
    policy = PolicyConfig(
        policy=f"lerobot:{folder}",
        contract=folder / CONTRACT_FILE,
        dual_rate=True,
        num_diffusion_steps=request.steps,
    )
    try:
        flown = _cells(fly(policy, Rates(action_rate=request.action_hz), request.flight_s))
    except UserError as error:
        flown = f"not flown: {str(error).splitlines()[-1]} | | | "
    return f"| {folder.name} | {flown} | {_peer_text(folder, request)} |"


def _cells(flight: Flight) -> str:
    chunk, image = flight.predict_ms, flight.encode_ms
    cells = (
        f"{flight.action_hz:.1f}, {flight.vision_hz:.1f}",
        f"{flight.missed_slots}",
        _text(chunk, both=True),
        _text(image, both=False),
    )
    return " | ".join(cells)


def _text(found: Percentiles | None, *, both: bool) -> str:
    if found is None:
        return "-"
    return f"{found.p50:.1f} / {found.p99:.1f} ms" if both else f"{found.p50:.1f} ms"


def _peer_text(folder: Path, request: Request) -> str:
    """LeRobot's time of a chunk on the same weights, or why it was not measured."""
    if request.peer is None:
        return "not measured: give --peer, the Python of an environment with lerobot"
    contract = read_plan(folder, folder / CONTRACT_FILE).interface.contract
    horizon = json.loads((folder / "config.json").read_text()).get("horizon", 1)
    images = (contract.observation_steps, len(contract.cameras), *contract.image_shape[-3:])
    with tempfile.TemporaryDirectory() as scratch:
        inputs = Path(scratch) / "inputs.npz"
        np.savez(
            inputs,
            state=np.zeros((contract.observation_steps, contract.state_dim), np.float32),
            images=np.full(images, 0.5, np.float32),
            noise=np.zeros((1, horizon, ACTION_DIM), np.float32),
        )
        command = [request.peer, str(PEER), "time", str(folder), str(inputs), str(request.steps)]
        try:
            run = subprocess.run(command, check=True, capture_output=True, text=True, timeout=600)
        except (OSError, subprocess.SubprocessError) as error:
            output = getattr(error, "stderr", None) or str(error)
            return f"not measured: {output.strip().splitlines()[-1]}"
    _best_ms, median_ms = json.loads(run.stdout.strip().splitlines()[-1])["ms"]
    return f"{median_ms:.0f} ms"


if __name__ == "__main__":
    main()
