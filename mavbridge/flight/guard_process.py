"""The guard process as seen by its parent: start it, send chunks, receive reports, wait for it."""

import os
import select
import socket
import subprocess
import sys
import threading
from contextlib import ExitStack, suppress
from dataclasses import replace

from mavbridge.config.flight import FlyConfig
from mavbridge.core.address import SocketAddress
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock, wall_offset_ns
from mavbridge.core.errors import MavbridgeError, PeerError
from mavbridge.core.processes import child_environment
from mavbridge.core.ticks import GuardTick
from mavbridge.flight.settings import link_settings
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.guard.channel import SocketPort, channel_pair
from mavbridge.guard.values import GuardSettings, Phase
from mavbridge.guard.wire import (
    NO_WORDS,
    FromGuard,
    GuardDiedError,
    GuardSummary,
    LastWords,
    ToGuard,
    decode_from_guard,
    encode,
)
from mavbridge.recording.tlog import TlogPipe, open_tlog_pipe

LISTEN_S = 0.1
"""Longest wait for a message between two checks of the stop flag."""
SILENT_WAITS = 3
"""Waits in a row without a message after which a guard that holds the vehicle stands still: it
reports each slot, every 50 ms at most."""
OPEN_S = 20.0
"""Longest wait for the guard to start and to open the link. TCP alone may take three seconds, and
the machine may be busy."""
CLOSE_S = 5.0
"""Longest wait for a guard that holds no sticks to end and free its port."""
REAP_S = 0.2
"""Longest wait for a guard whose channel is closed to exit. Nothing is sent while it lives."""
LATEST_NS = 500 * NS_PER_MS
"""Oldest report of a dead guard for which its last words are still sent. Later, the vehicle may
have left our sticks by its own timeout or by its pilot."""
_STILL_OURS = (Phase.FLYING, Phase.LEAVING, Phase.HOLDING)
OWN_TIMEOUT = (
    "the vehicle holds the last sticks or setpoint until its own timeout (ArduPilot: "
    "RC_OVERRIDE_TIME, GUID_TIMEOUT; PX4: COM_RC_LOSS_T, COM_OF_LOSS_T)"
)


class GuardProcess:
    """Handle of the guard process. ``send`` is thread-safe; ``listen`` needs a thread of its
    own."""

    def __init__(self, settings: GuardSettings, clock: Clock) -> None:
        """Start the process, which begins to look for the vehicle."""
        ours, theirs = channel_pair()
        samples, their_samples = channel_pair()
        self._clock = clock
        self._port = SocketPort(ours)
        self.samples = SocketPort(samples)
        """The vehicle's readings, for a ``TelemetryCache``."""
        self._leftover = "; what --set has changed stays so" if settings.link.set_params else ""
        self._words = NO_WORDS
        self._outlet: int | None = None
        """Duplicate of the guard's socket or port while it holds the vehicle."""
        self._newest: GuardTick | None = None
        self._lock = threading.Lock()
        self._process = _spawn((theirs, their_samples), settings)
        theirs.close()
        their_samples.close()
        for end in (ours, samples):  # a policy's forks must not hide our death from the guard
            os.register_at_fork(after_in_child=end.close)
        self._early: list[FromGuard] = []
        """Messages received before ``listen``."""
        self.summary: GuardSummary | None = None
        """Final summary; None until the guard has ended in order."""
        self.tlog_pipe: TlogPipe | None = None
        """Telemetry log of a flight that is recorded."""
        self.wall_offset_ns = settings.wall_offset_ns
        """Offset from the clock to the Unix time of the log's stamps."""
        self.error: MavbridgeError | None = None
        """Error that ended the guard."""
        self.is_stuck = False
        """True if the guard stands still and was not killed."""

    @property
    def pid(self) -> int:
        """Process id of the guard."""
        return self._process.pid

    def send(self, message: ToGuard) -> bool:
        """Send a message without waiting; return False if it was dropped."""
        with self._lock:
            return self._port.send(encode(message))

    def wait_until_open(self, timeout_s: float = OPEN_S) -> None:
        """Wait for the guard's first message, sent when the link is open. Call before ``listen``.

        Raises:
            PeerError, UserError: the vehicle's address cannot be used.
            GuardDiedError: the guard has exited, or sends nothing within ``timeout_s``.
        """
        if not select.select([self._port], [], [], timeout_s)[0]:
            raise GuardDiedError(f"the guard process has been silent for {timeout_s:g} s")
        self._early = [decode_from_guard(data) for data in self._port.receive()]
        for message in self._early:
            if isinstance(message, MavbridgeError):
                raise message
        if not self._early and self._port.is_closed:
            raise GuardDiedError("the guard process has ended before it opened the link")

    def listen(self, stop: threading.Event, view: TelemetryCache) -> None:
        """Pass the guard's messages to ``view`` until it ends or ``stop`` is set.

        A guard that stands still while it holds the vehicle is killed, since nothing may be sent in
        its place while it lives. Where that would come too late, it is left to end the flight by
        itself, should it go on.

        Raises:
            GuardDiedError: the guard has exited without its summary, or stands still.
            PeerError, UserError: the error that the guard reported.
        """
        early, self._early = self._early, []
        for message in early:
            self._take(message, view)
        if stands_still := self._stands_still(stop, view):
            if (late := self._too_late()) is not None:
                self.is_stuck = True
                raise GuardDiedError(f"the guard (process {self.pid}) stands still: {late}")
            self._process.kill()
        if self.error is not None:
            raise self.error
        if self.summary is None and not stop.is_set():
            left, code = self._speak(), self._process.returncode
            if code is None and self.wait(REAP_S):
                code = self._process.returncode
            if code == 0:  # it waits 2 s for its summary to be read
                raise GuardDiedError("the guard ended the flight while this process stood still")
            by = f" (signal {-code})" if code is not None and code < 0 else ""
            if stands_still:
                by = f", killed after {SILENT_WAITS * LISTEN_S:g} s in which it stood still"
            raise GuardDiedError(f"the guard process has died{by}: {left}{self._leftover}")
        if self.summary is not None and self.summary.outcome.failure is not None:
            raise PeerError(str(self.summary.outcome.failure))

    def _stands_still(self, stop: threading.Event, view: TelemetryCache) -> bool:
        """Pass messages on; return True once a guard that holds the vehicle sends none any more.

        False: it has ended, or ``stop`` is set.
        """
        silent_waits = 0
        while not (stop.is_set() or self._port.is_closed):
            is_heard = bool(select.select([self._port], [], [], LISTEN_S)[0])
            for data in self._port.receive():
                self._take(decode_from_guard(data), view)
            silent_waits = 0 if is_heard else silent_waits + 1
            if silent_waits == SILENT_WAITS and self._holds_vehicle():
                return True
        return False

    def _holds_vehicle(self) -> bool:
        """True if the last words, but for their age, could be sent, were the guard dead."""
        newest, words = self._newest, self._words
        is_held = newest is not None and newest.phase in (words.phase, *_STILL_OURS)
        return is_held and bool(words.packets)

    def _too_late(self) -> str | None:
        """Return what to tell the user if the last words are too old to be sent, or None."""
        silent_ns = 0 if self._newest is None else self._clock.now_ns() - self._newest.sent_ns
        if silent_ns <= LATEST_NS:
            return None
        silent_s = silent_ns / NS_PER_S
        return f"silent for {silent_s:.1f} s, too long to send its last words; {OWN_TIMEOUT}"

    def _take(self, message: FromGuard, view: TelemetryCache) -> None:
        match message:
            case GuardSummary():
                self.summary = message
            case MavbridgeError():
                self.error = message
            case LastWords():
                self._keep(message)
            case GuardTick():
                self._newest = message
                view.receive(message)
            case _:
                view.receive(message)

    def _keep(self, words: LastWords) -> None:
        """Store the guard's last words, and the descriptor to send them through."""
        self._words = words
        if words.brings_file or not words.packets:
            self._close_outlet()
        if words.brings_file and self._port.files:
            self._outlet = self._port.files.popleft()

    def _close_outlet(self) -> None:
        if self._outlet is not None:
            os.close(self._outlet)
            self._outlet = None

    def _speak(self) -> str:
        """Send the last words of a guard that has died; return a description for the user."""
        died_ns, words = self._clock.now_ns(), self._words
        if not words.packets:
            return "it held no sticks"
        if not self._holds_vehicle():
            return "it had released the sticks"
        if not self.wait(REAP_S):
            return f"it does not exit, so nothing was sent in its place; {OWN_TIMEOUT}"
        if (late := self._too_late()) is not None:
            return late
        sent = 0
        for after_ns, packet in words.packets:
            self._clock.sleep_until_ns(died_ns + after_ns)
            sent += self._transmit(packet, words.receiver)
        if sent == 0:
            return f"its last words could not be sent; {OWN_TIMEOUT}"
        asked = f", then {words.mode}" if words.mode else ""
        return (
            f"its last words were sent in its place (neutral{asked}), but the answer cannot be "
            "received: take over the vehicle; without a receiver its own failsafe may follow"
        )

    def _transmit(self, packet: bytes, receiver: SocketAddress | None) -> bool:
        """Send one packet through the guard's socket or port without waiting."""
        if self._outlet is None:
            return False
        with suppress(OSError):
            if receiver is None:
                return os.write(self._outlet, packet) == len(packet)
            with socket.socket(fileno=os.dup(self._outlet)) as udp:
                return udp.sendto(packet, receiver) == len(packet)
        return False

    def wait(self, timeout_s: float) -> bool:
        """Wait for the process to exit; return whether it has."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self) -> None:
        """Close the channel. A running guard takes this for our death, and ends when it may."""
        self._port.close()
        self.samples.close()
        newest = self._newest if self.summary is None else None
        is_holding = newest is not None and newest.phase is Phase.HOLDING
        self.wait(0.0 if self.is_stuck or is_holding else CLOSE_S)
        self._close_outlet()


def _spawn(
    ends: tuple[socket.socket, socket.socket], settings: GuardSettings
) -> subprocess.Popen[bytes]:
    files = [end.fileno() for end in ends]
    passed = files + ([] if settings.tlog_fd is None else [settings.tlog_fd])
    process = subprocess.Popen(
        [sys.executable, "-m", "mavbridge.guard", *map(str, files)],
        env=child_environment(),
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        pass_fds=passed,
        start_new_session=True,  # the terminal's signals are not for the guard
    )
    assert process.stdin is not None
    with suppress(BrokenPipeError), process.stdin:
        process.stdin.write(encode(settings))
    return process


def start_guard(
    config: FlyConfig, clock: Clock, stack: ExitStack, *, pilot_hz: float | None = None
) -> GuardProcess:
    """Start the guard process. Closing ``stack`` closes its channel, which ends it.

    ``pilot_hz``: rate of a pilot's sticks, recorded with all packets while none of ours is sent.
    """
    link = link_settings(config)
    if pilot_hz is not None:
        link = replace(link, pilot_hz=pilot_hz, stick_hz=0.0)
    tlog_pipe = None if config.record is None else open_tlog_pipe()
    if tlog_pipe is not None:
        stack.callback(tlog_pipe.close)
    settings = GuardSettings(
        link=link,
        realtime=config.rates.realtime,
        tlog_fd=None if tlog_pipe is None else tlog_pipe.writer.fileno(),
        keeps_packets=tlog_pipe is not None or pilot_hz is not None,
        wall_offset_ns=wall_offset_ns(clock),
    )
    guard = GuardProcess(settings, clock)
    stack.callback(guard.close)
    guard.tlog_pipe = tlog_pipe
    if tlog_pipe is not None:
        tlog_pipe.writer.close()
    return guard
