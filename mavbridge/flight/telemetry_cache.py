"""The vehicle and the sent actions as the flight process knows them, from the guard's messages."""

import logging
import select
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from dataclasses import fields
from itertools import groupby

from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.reasons import Reason
from mavbridge.core.records import Position, Solve, Tick, TickSink, VehicleState
from mavbridge.core.ticks import GuardTick
from mavbridge.core.vehicle import ForwardedPacket, Sample, Telemetry
from mavbridge.flight.history import SentHistory
from mavbridge.flight.plan import FlightPlan
from mavbridge.flight.state import StateReader, keeps_past
from mavbridge.guard.channel import SocketPort
from mavbridge.guard.values import Phase
from mavbridge.guard.wire import (
    FromGuard,
    GuardStatus,
    GuardSummary,
    LastWords,
    Packets,
    Samples,
    decode_from_guard,
)

_log = logging.getLogger(__name__)
POSITION_NS = NS_PER_S
"""Oldest position that a tick reports. Nothing is flown by it."""
MAX_PAST = 4096
"""Attitudes queued for the next solve: ten seconds of the fastest stream."""
MAX_SOLVES = 256
"""Chunks whose inputs are kept until the guard reports that it has flown them."""
_REPORTED = tuple(field.name for field in fields(GuardTick))


class TelemetryCache:
    """Telemetry, sent actions and phase; turns the guard's reports into ticks.

    One thread calls ``receive`` while the policy's thread waits for attitudes; the simulation does
    both in one thread.
    """

    def __init__(
        self,
        plan: FlightPlan,
        *,
        sink: TickSink,
        samples: SocketPort | None = None,
        watch_packets: Callable[[tuple[ForwardedPacket, ...]], object] = lambda packets: None,
    ) -> None:
        """Start without a vehicle.

        Args:
            plan: tells the frame, the age limits and the history of states and actions.
            sink: takes a tick for every send, and for every slot without one.
            samples: where the vehicle's readings come from, if not by ``receive``: the thread that
                waits for an attitude reads them itself, so that no other one has to wake it.
            watch_packets: is given packets for a recorder, in the same thread; must not block.
        """
        self.history = SentHistory(plan.contract)
        """Every action that was sent."""
        self.reader = StateReader(plan)
        self._sink, self._readonly = sink, plan.config.link.readonly
        self._watch_packets = watch_packets
        self.telemetry = Telemetry()
        """Newest reading of each quantity."""
        self._past: deque[Telemetry] | None = deque(maxlen=MAX_PAST) if keeps_past(plan) else None
        """Telemetry at each attitude since the last solve."""
        self._solves: OrderedDict[int, tuple[Solve, int]] = OrderedDict()
        """By serial number of the chunk: the solve, and the exposure of its image."""
        self._samples = samples
        self._lock = threading.Lock()
        """Held while samples are read."""
        self._is_awaited = False
        """True while the policy's thread waits and reads the samples itself."""
        self._texts: list[str] = []
        self.status = GuardStatus("none", None, False, None, (), None)
        self.is_found = False
        """True once the vehicle has told its mode, also if a reboot has made it unknown again."""
        self._was_flown = False
        """True if the policy moved the sticks at the last tick."""
        self.phase = Phase.WAITING
        self.reason: Reason | None = None
        self.starting_ns = 0
        """Time from which the policy is to be reset for a flight; 0: no reset is due."""

    # --- the reader's side

    @property
    def height_m(self) -> float | None:
        """Height above the estimator's origin [m]; None without a position."""
        position = self.telemetry.position_ned_m
        return None if position is None else -position.values[2]

    @property
    def is_airborne(self) -> bool:
        """True if the vehicle is armed, and reports that it is not landed."""
        return self.status.armed and self.status.is_landed is False

    def take_past(self, until_ns: int) -> list[Telemetry]:
        """Return the telemetry at each attitude since the last call, up to arrival ``until_ns``."""
        taken: list[Telemetry] = []
        while self._past and self._past[0].attitude_arrived_ns <= until_ns:
            taken.append(self._past.popleft())
        return taken

    def wait_for_attitude(self, clock: Clock, *, newer_than_ns: int, timeout_ns: int) -> bool:
        """Wait for an attitude that arrived after ``newer_than_ns``; return False on timeout."""
        port, until_ns = self._samples, clock.now_ns() + timeout_ns
        assert port is not None
        with self._lock:
            self._is_awaited = True
        try:
            while True:
                for data in port.receive():
                    self.receive(decode_from_guard(data))
                if self.telemetry.attitude_arrived_ns > newer_than_ns:
                    return True
                if (left_ns := until_ns - clock.now_ns()) <= 0:
                    return False
                select.select([] if port.is_closed else [port], [], [], left_ns / NS_PER_S)
        finally:
            self._is_awaited = False

    def remember(self, solve: Solve, captured_ns: int) -> None:
        """Keep a solve, and the exposure of its image, for the ticks that will fly its chunk."""
        self._solves[solve.serial] = solve, captured_ns
        if len(self._solves) > MAX_SOLVES:
            self._solves.popitem(last=False)

    # --- the guard's side

    def take_texts(self) -> tuple[str, ...]:
        """Return lines for the user that no tick has carried yet."""
        texts, self._texts = tuple(self._texts), []
        return texts

    def receive(self, message: FromGuard) -> None:
        """Handle one message of the guard."""
        match message:
            case Samples(samples):
                self._receive_samples(samples)
            case GuardTick():
                self._receive_tick(message)
            case GuardStatus():
                if message[:4] != self.status[:4]:
                    _log.debug("vehicle: %s, %s, armed %s, landed %s", *message[:4])
                self.status = message
                self.is_found = self.is_found or message.mode is not None
            case str() as text:
                self._texts.append(text)
            case Packets(packets):
                self._watch_packets(packets)
            case MavbridgeError() | GuardSummary() | LastWords():
                pass  # its end is the business of whoever has started it

    def _receive_samples(self, samples: Iterable[Sample]) -> None:
        if self._past is None:
            self.telemetry = self.telemetry._replace(**dict(samples))
            return
        for _, datagram in groupby(samples, key=lambda sample: sample.reading.arrived_ns):
            known, self.telemetry = self.telemetry, self.telemetry._replace(**dict(datagram))
            # After each datagram: which of them came in one batch is not in a recording.
            if self.telemetry.attitude_arrived_ns != known.attitude_arrived_ns:
                self._past.append(self.telemetry)

    def _receive_tick(self, tick: GuardTick) -> None:
        with self._lock:
            if self._samples is not None and not self._is_awaited:
                for data in self._samples.receive():  # a slow policy leaves them to us
                    self.receive(decode_from_guard(data))
        self.phase, self.reason = Phase(tick.phase), tick.release_reason
        self.starting_ns = tick.starting_ns
        joined = self._join(tick)
        if not joined.is_refused:  # else the vehicle still flies the last action
            self.history.append(tick.sent, tick.sent_ns)
        self._sink.emit(joined)
        self._was_flown = tick.trace is not None

    def _join(self, sent: GuardTick) -> Tick:
        """Join the guard's report with the inputs of the chunk that was flown."""
        no_solve: tuple[Solve | None, int | None] = None, None
        solve, captured_ns = self._solves.get(sent.chunk_serial or 0, no_solve)
        state = solve.state if solve else self.reader.motion(self.telemetry, sent.sent_ns)
        position = self.telemetry.position_ned_m
        is_placed = position is not None and sent.sent_ns - position.arrived_ns <= POSITION_NS
        reported = {name: getattr(sent, name) for name in _REPORTED}
        if not (self._was_flown and sent.trace):
            reported["missed_slots"] = 0
        return Tick(
            **reported,
            predict_ns=solve.computed_ns - solve.started_ns if solve else None,
            feature_frame_id=solve.frame_ids[-1][0] if solve else None,
            feature_captured_ns=captured_ns,
            state=state if isinstance(state, VehicleState) else None,
            mode=self.status.mode,
            armed=self.status.armed,
            rc_channels_us=self.status.rc_channels_us,
            rc_sticks=self.status.rc_sticks,
            texts=self.take_texts(),
            chunk_computed_ns=solve.computed_ns if solve else None,
            position_ned_m=Position(*position.values) if position and is_placed else None,
            readonly=self._readonly,
        )
