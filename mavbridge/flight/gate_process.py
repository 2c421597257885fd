"""The gate process as its parent sees it: started, fed with chunks, listened to, waited for."""

import select
import socket
import subprocess
import sys
import threading

from mavbridge.core.errors import ExitCode, MavbridgeError, PeerError, UserError
from mavbridge.core.processes import child_environment
from mavbridge.flight.vehicle_view import VehicleView
from mavbridge.gate.channel import SocketPort, channel_pair
from mavbridge.gate.settings import GateSettings
from mavbridge.gate.wire import (
    FromGate,
    GateError,
    GateSummary,
    ToGate,
    decode_from_gate,
    encode_to_gate,
)

LISTEN_S = 0.1
"""Longest wait for a message before the stop flag is checked."""
OPEN_S = 20.0
"""Longest wait for a gate to start and to open the link: it imports little, and TCP is given three
seconds, but the machine may be busy."""
CLOSE_S = 5.0
"""Longest wait for a gate that holds no sticks to end and free its port."""


class GateDiedError(MavbridgeError):
    """The gate process is gone without having ended in order."""

    exit_code = ExitCode.FAULT


class GateProcess:
    """Starts the gate; ``send`` may be called by any thread, ``listen`` runs in one of its own."""

    def __init__(self, settings: GateSettings) -> None:
        """Start the process; it looks for the vehicle from then on."""
        ours, theirs = channel_pair()
        self._port = SocketPort(ours)
        self._lock = threading.Lock()
        self._process = _spawn(theirs, settings)
        theirs.close()
        self._early: list[FromGate] = []
        """Messages that came before ``listen``."""
        self.summary: GateSummary | None = None
        """The gate's last words; None until it has ended in order."""
        self.error: MavbridgeError | None = None
        """Why the gate could not go on."""
        self.send(settings)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def send(self, message: ToGate) -> bool:
        """Hand over a message; False: it was dropped. Never waits for the gate."""
        with self._lock:
            return self._port.send(encode_to_gate(message))

    def wait_until_open(self, timeout_s: float = OPEN_S) -> None:
        """Wait for its first word, which says that the link is open; called before ``listen``.

        Raises:
            PeerError, UserError: the address of the vehicle, or of --forward, cannot be used.
            GateDiedError: it has ended at once, or says nothing in time.
        """
        if not select.select([self._port], [], [], timeout_s)[0]:
            raise GateDiedError(f"the gate process has said nothing for {timeout_s:g} s")
        self._early = [decode_from_gate(data) for data in self._port.receive()]
        for message in self._early:
            if isinstance(message, GateError):
                raise _as_exception(message)
        if not self._early and self._port.is_closed:
            raise GateDiedError("the gate process has ended before it opened the link")

    def listen(self, stop: threading.Event, view: VehicleView) -> None:
        """Pass the gate's messages to ``view`` until it ends or ``stop`` is set.

        Raises:
            GateDiedError: the gate has ended without its summary.
            PeerError, UserError: the reason that the gate gave.
        """
        early, self._early = self._early, []
        for message in early:
            self._take(message, view)
        while not stop.is_set():
            select.select([self._port], [], [], LISTEN_S)
            for data in self._port.receive():
                self._take(decode_from_gate(data), view)
            if self._port.is_closed:
                break
        if self.error is not None:
            raise self.error
        if self.summary is None and not stop.is_set():
            raise GateDiedError(
                "the gate process has died: the vehicle keeps the last sticks or setpoint until "
                "its own timeout (ArduPilot: RC_OVERRIDE_TIME, GUID_TIMEOUT; PX4: COM_RC_LOSS_T, "
                "COM_OF_LOSS_T)"
            )
        if self.summary is not None and self.summary.failure is not None:
            raise PeerError(self.summary.failure)

    def _take(self, message: FromGate, view: VehicleView) -> None:
        match message:
            case GateSummary():
                self.summary = message
            case GateError():
                self.error = _as_exception(message)
            case _:
                view.receive(message)

    def wait(self, timeout_s: float) -> bool:
        """Wait for the process to end by itself; returns whether it has."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self) -> None:
        """Close the channel: a gate that still runs takes it for our death, and ends by itself."""
        self._port.close()
        self.wait(CLOSE_S)


def _spawn(end: socket.socket, settings: GateSettings) -> subprocess.Popen[bytes]:
    passed = [end.fileno()] + ([] if settings.tlog_fd is None else [settings.tlog_fd])
    return subprocess.Popen(
        [sys.executable, "-m", "mavbridge.gate", str(end.fileno())],
        env=child_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        pass_fds=passed,
        start_new_session=True,  # the terminal's signals are not for the gate
    )


def _as_exception(error: GateError) -> MavbridgeError:
    match error.kind:
        case "user":
            return UserError(error.text)
        case "peer":
            return PeerError(error.text)
        case "bug":
            return GateDiedError(f"the gate process has failed, a bug of mavbridge:\n{error.text}")
