"""A flight in real processes: sitl, a recording relay, mavbridge; everything on loopback."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.processes import free_port

TIMEOUT_S = 90.0


class Override(NamedTuple):
    """The first four channels of one RC_CHANNELS_OVERRIDE, in us."""

    roll: int
    pitch: int
    throttle: int
    yaw: int


class Relay:
    """Passes datagrams between the vehicle and the bridge, and keeps the bridge's sticks."""

    def __init__(self, bridge_port: int) -> None:
        self._bridge = ("127.0.0.1", bridge_port)
        self._vehicle: tuple[str, int] | None = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.2)
        self._mav = dialect.MAVLink(None)
        self._mav.robust_parsing = True
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="relay")
        self.overrides: list[Override] = []
        self.has_flown = threading.Event()
        self.port: int = self._socket.getsockname()[1]

    def __enter__(self) -> "Relay":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5)
        self._socket.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                data, sender = self._socket.recvfrom(65536)
            except (TimeoutError, ConnectionError):
                continue
            if sender == self._bridge:
                self._record(data)
                target = self._vehicle
            else:
                self._vehicle, target = sender, self._bridge
            if target is not None:
                self._socket.sendto(data, target)

    def _record(self, data: bytes) -> None:
        for message in self._mav.parse_buffer(data) or ():
            if message.get_type() != "RC_CHANNELS_OVERRIDE":
                continue
            sticks = Override(*(getattr(message, f"chan{k}_raw") for k in range(1, 5)))
            self.overrides.append(sticks)
            if sticks.throttle > 1500:  # the policy climbs
                self.has_flown.set()


class Flight:
    """One bridge against one simulated vehicle."""

    def __init__(self, folder: Path, relay: Relay, bridge_port: int, shm: str) -> None:
        self.folder = folder
        self.relay = relay
        self._connect = f"udp:127.0.0.1:{bridge_port}"
        self._shm = shm
        self._bridge: subprocess.Popen[str] | None = None
        self._lines: list[str] = []
        self._news = threading.Condition()
        self._reader = threading.Thread(target=self._read, name="reader")

    def start(self, *flags: str) -> None:
        command = [sys.executable, "-m", "mavbridge", "--connect", self._connect]
        command += ["--camera", f"shm:{self._shm}", "--report", str(self.folder / "report.json")]
        self._bridge = subprocess.Popen(
            [*command, *flags],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1]), "COLUMNS": "200"},
        )
        self._reader.start()

    def _read(self) -> None:
        assert self._bridge is not None
        assert self._bridge.stdout is not None
        for line in self._bridge.stdout:
            with self._news:
                self._lines.append(line)
                self._news.notify_all()

    def wait_for(self, text: str) -> bool:
        """The bridge has said this."""
        with self._news:
            return self._news.wait_for(
                lambda: any(text in line for line in self._lines), timeout=TIMEOUT_S
            )

    @property
    def bridge_pid(self) -> int:
        assert self._bridge is not None
        return self._bridge.pid

    def kill(self, number: signal.Signals) -> None:
        assert self._bridge is not None
        self._bridge.send_signal(number)

    def end(self) -> tuple[int, str]:
        """Exit status and everything that the bridge printed."""
        assert self._bridge is not None
        try:
            self._bridge.wait(TIMEOUT_S)
        finally:
            if self._bridge.poll() is None:
                self._bridge.kill()
                self._bridge.wait()
            self._reader.join(TIMEOUT_S)
            if self._bridge.stdout is not None:
                self._bridge.stdout.close()
        return self._bridge.returncode, "".join(self._lines)

    def report(self) -> Any:
        return json.loads((self.folder / "report.json").read_text())

    def vehicle_report(self) -> Any:
        """Only after the ``flight`` block, which ends the vehicle."""
        return json.loads((self.folder / "fc.json").read_text())


@contextmanager
def flight(folder: Path, *vehicle_flags: str) -> Iterator[Flight]:
    """A vehicle and a relay, ready for ``Flight.start``; both end with the block."""
    bridge_port = free_port()
    shm = f"test-{bridge_port}-{os.getpid()}"
    with Relay(bridge_port) as relay:
        command = [sys.executable, "-m", "sitl", "--connect", f"udpout:127.0.0.1:{relay.port}"]
        command += ["--camera", f"shm:{shm}", "--report", str(folder / "fc.json")]
        vehicle = subprocess.Popen([*command, *vehicle_flags], stderr=subprocess.DEVNULL)
        try:
            yield Flight(folder, relay, bridge_port, shm)
        finally:
            vehicle.terminate()
            vehicle.wait(TIMEOUT_S)
