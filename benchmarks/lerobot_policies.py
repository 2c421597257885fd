"""Time LeRobot policies on our engines, and with LeRobot's code on the same weights.

    python -m benchmarks.lerobot_policies DIR... [--steps 4] [--peer PYTHON_OF_LEROBOT]

DIR holds a checkpoint and its mavbridge.toml; ``benchmarks/lerobot_peer.py make`` makes one with
random weights. Times are milliseconds in one thread. LeRobot's are per whole chunk: it encodes the
images of all observations each time, mavbridge only one.
"""

import json
import subprocess
from pathlib import Path

from cyclopts import App

from benchmarks.engines import time_engines
from benchmarks.results import EngineTiming, engine_table
from mavbridge.commands.output import table_console
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.errors import UserError

PEER = Path(__file__).with_name("lerobot_peer.py")
TIMEOUT_S = 600.0
app = App(help=__doc__)


@app.default
def main(*folders: Path, steps: int = 4, peer: Path | None = None) -> None:
    """Print a row for each piece of work of each checkpoint.

    Args:
        folders: checkpoints.
        steps: DDIM steps.
        peer: the Python of LeRobot's environment.
    """
    policies = [
        PolicyConfig(
            policy=f"lerobot:{folder}",
            contract=folder / "mavbridge.toml",
            dual_rate=True,
            num_diffusion_steps=steps,
        )
        for folder in folders
    ]
    timings, notes = time_engines(policies, rounds=3, block_s=1.5)
    if peer is not None:
        timings += tuple(time_peer(peer, folder, steps) for folder in folders)
    console = table_console()
    console.print(engine_table(timings))
    for note in notes:
        console.print(note)


def time_peer(python: Path, folder: Path, steps: int) -> EngineTiming:
    """Return LeRobot's time per chunk.

    Raises:
        UserError: LeRobot did not compute it; quotes its last line.
    """
    command = [str(python), str(PEER), "time", str(folder), str(steps)]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S)
    if answer.returncode:
        raise UserError(f"{' '.join(command)}: {(answer.stderr.splitlines() or ['failed'])[-1]}")
    p50_ms, p99_ms = json.loads(answer.stdout.splitlines()[-1])
    return EngineTiming(
        policy=f"lerobot:{folder}",
        work="images to chunk",
        engine="LeRobot",
        p50_ms=p50_ms,
        p99_ms=p99_ms,
    )


if __name__ == "__main__":
    app()
