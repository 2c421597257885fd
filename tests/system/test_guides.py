"""Runs the terminals of the guides against the bundled vehicle, on the firmware's own ports.

docs/simulators.md and docs/companion_computers.md: what is typed there is run as it stands, but for
free ports, folders of the test and a shorter flight. How well it flies is for other tests: this
machine may be busy.
"""

import re
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

from faults.stage import VEHICLE
from helpers.guides import ROOT, blocks, command_lines
from mavbridge.core.processes import free_port, running
from mavbridge.recording.flight_folder import open_flight

TIMEOUT_S = 90.0
STARTS = 3
IN_CONTROL = "the policy has control"
PEERS = ROOT / ".venv-peers" / "bin"
MARK = "run by tests/system/test_guides.py"


@pytest.fixture
def ports() -> dict[str, str]:
    """Free ports in place of those in the guides."""
    return {name: str(free_port()) for name in ("5762", "5763", "14540", "14550")}


def typed(page: str, firmware: str) -> list[list[str]]:
    """Words of the commands of a page that are marked as run here, for one firmware or program."""
    marked = (block for block in blocks(ROOT / page) if block.mark == f"{MARK}: {firmware}")
    return [words for block in marked for words in command_lines(block.text)]


def here(words: Sequence[str], ports: dict[str, str], folder: Path) -> list[str]:
    """The command with this test's ports, frames and folder, for three seconds of flight."""
    line = "\n".join(words)
    for port, free in ports.items():
        line = re.sub(rf"(?<=:){port}$", free, line, flags=re.M)
    line = line.replace("shm:fpv", f"shm:fpv-{ports['5762']}")
    line = re.sub(r"(?<=^--duration\n)\d+", "3", line, flags=re.M)
    line = re.sub(r"(?<=^--record\n)\S+", str(folder), line, flags=re.M)
    program, *rest = line.split("\n")
    if program == "mavbridge":
        return [sys.executable, "-m", "mavbridge", *rest]
    if program == "mavproxy.py":
        log = f"--logfile={folder.with_suffix('.tlog')}"
        return [str(PEERS / "python"), str(PEERS / program), log, *rest]
    assert program == "python"
    return [sys.executable, *rest]


def fly(vehicle: Sequence[str], terminals: Sequence[Sequence[str]], folder: Path) -> str:
    """What the last terminal printed; the others run beside it, and the vehicle."""
    with ExitStack() as stack:
        beside = ([sys.executable, "-c", VEHICLE, *vehicle], *terminals[:-1])
        for number, command in enumerate(beside):
            stack.enter_context(running(*command, log=folder / f"{number}.log"))
        flight = subprocess.run(
            terminals[-1],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
    return flight.stdout + flight.stderr


def fly_guide(
    page: str, firmware: str, vehicle: Sequence[str], ports: dict[str, str], folder: Path
) -> Path:
    """Fly until the policy had control once, anew where a busy machine prevented it."""
    output = ""
    for start in range(STARTS):
        recording = folder / str(start)
        terminals = [here(words, ports, recording) for words in typed(page, firmware)]
        output = fly(vehicle, terminals, folder)
        if IN_CONTROL in output:
            return recording
    raise AssertionError(output)


def test_the_terminals_of_the_guide_to_ardupilot_fly(ports: dict[str, str], tmp_path: Path) -> None:
    links = ["--connect", f"tcpin:127.0.0.1:{ports['5762']}"]
    links += ["--connect", f"tcpin:127.0.0.1:{ports['5763']}"]
    recording = fly_guide("docs/simulators.md", "ArduPilot", links, ports, tmp_path)
    assert any(True for _ in open_flight(recording).frame_rows())


def test_the_terminals_of_the_guide_to_px4_fly(ports: dict[str, str], tmp_path: Path) -> None:
    links = ["--autopilot", "px4", "--connect", f"udpout:127.0.0.1:{ports['14550']}"]
    links += ["--connect", f"udpout:127.0.0.1:{ports['14540']}"]
    recording = fly_guide("docs/simulators.md", "PX4", links, ports, tmp_path)
    assert any(True for _ in open_flight(recording).frame_rows())


@pytest.mark.skipif(not (PEERS / "mavproxy.py").exists(), reason="MAVProxy is not installed")
def test_mavproxy_of_the_guide_shares_the_link(ports: dict[str, str], tmp_path: Path) -> None:
    links = ["--connect", f"tcpin:127.0.0.1:{ports['5762']}"]
    fly_guide("docs/companion_computers.md", "MAVProxy", links, ports, tmp_path)
