"""MAVProxy and MAVSDK-Python, as installed from PyPI, take the mock for a vehicle.

They live in an environment of their own (``.venv-peers``); the vehicle is the real process.
"""

import json
import os
import selectors
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from mavbridge.core.processes import end, free_port
from sitl.ardupilot.params import ArduPilotParams
from sitl.clock import NS_PER_S, Clock

PEERS = Path(__file__).parents[2] / ".venv-peers" / "bin"
CLIENT = Path(__file__).parents[1] / "helpers" / "mavsdk_client.py"
DEADLINE_S = 40.0

pytestmark = pytest.mark.peers


def need(program: str) -> None:
    if not (PEERS / program).exists():
        pytest.skip(f"{program} is not installed in .venv-peers")


@contextmanager
def running(*command: str, cwd: Path | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """A process with pipes, ended with the context."""
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        cwd=cwd,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    ) as process:
        try:
            yield process
        finally:
            end(process)


class Console:
    """A program's terminal: type a line, wait for a text."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process
        self._clock = Clock()
        self.seen = ""

    def type(self, line: str) -> None:
        self._process.stdin.write(line.encode() + b"\n")
        self._process.stdin.flush()

    def has(self, text: str, timeout_s: float) -> bool:
        """True if the text appears in the output from now on."""
        self.seen = ""
        end_ns = self._clock.now_ns() + round(timeout_s * NS_PER_S)
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            while text not in self.seen:
                left_s = (end_ns - self._clock.now_ns()) / NS_PER_S
                if left_s <= 0.0 or not selector.select(left_s):
                    return False
                data = os.read(self._process.stdout.fileno(), 65536)
                if not data:
                    return False
                self.seen += data.decode("utf-8", "replace")
        return True

    def ask(self, line: str, answer: str) -> None:
        """Type the line, again where it must be, until the answer comes."""
        for _ in range(8):
            self.type(line)
            if self.has(answer, DEADLINE_S / 8):
                return
        pytest.fail(f"no {answer!r} after {line!r}; last: {self.seen!r}")


@contextmanager
def vehicle(connect: str) -> Iterator[None]:
    sitl = (sys.executable, "-m", "sitl", "--receiver", "idle", "--connect", connect)
    with running(*sitl) as process:
        assert Console(process).has("ready", DEADLINE_S)
        yield


def test_mavproxy_reads_parameters_changes_mode_and_arms(tmp_path):
    need("mavproxy.py")
    port = free_port(socket.SOCK_STREAM)
    with vehicle(f"tcpin:127.0.0.1:{port}"):
        proxy = running(
            str(PEERS / "python"),
            str(PEERS / "mavproxy.py"),
            f"--master=tcp:127.0.0.1:{port}",
            "--default-modules=param,mode,rc,arm",
            cwd=tmp_path,
        )
        with proxy as mavproxy:
            console = Console(mavproxy)
            assert console.has("parameters", DEADLINE_S), console.seen
            console.ask("mode ALT_HOLD", "Mode ALT_HOLD")
            console.type("rc 3 1000")
            console.ask("arm throttle", "ARMED")
            console.ask("disarm", "DISARMED")


def test_mavsdk_gets_parameters_telemetry_and_arms():
    need("python")
    port = free_port()
    with vehicle(f"udpout:127.0.0.1:{port}"):
        client = running(str(PEERS / "python"), str(CLIENT), f"udpin://127.0.0.1:{port}")
        with client as mavsdk:
            console = Console(mavsdk)
            assert console.has("}\n", DEADLINE_S), console.seen
    found = json.loads(console.seen.partition("RESULT ")[2].splitlines()[0])
    assert found == {
        "param": 0.5,
        "params": len(ArduPilotParams().names),
        "attitude": True,
        "position": True,
        "version": 4,
    }
