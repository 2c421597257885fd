"""Hostile datagrams against a whole flight: link, guard, policy loop, vehicle, in simulated time.

The datagrams come as if from the socket, between those of a simulated vehicle that goes on being
honest. In a row: while the vehicle is looked for, while nobody has engaged, in flight from
strangers, in flight as if from the vehicle, while the sticks are given back, and then the vehicle
must be flyable again.
"""

import gc
import sys
import types
from collections import deque
from collections.abc import Callable
from random import Random

from fuzz.codec_target import failure
from fuzz.datagrams import Datagrams
from fuzz.wire_judge import WireJudge
from helpers.output_flights import COMBINATIONS as COMBINATIONS
from helpers.output_flights import OutputFlight
from helpers.wire import WireEnd
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import PeerError
from mavbridge.core.ticks import GuardTick
from mavbridge.core.vehicle import ActionKind
from mavbridge.guard.memory import ACT_TIMEOUT_NS
from mavbridge.guard.values import Phase
from mavbridge.mavlink.transport.connection import Address, Received
from mavbridge.simulation.network import VEHICLE
from sitl.vehicle.config import AutopilotName

STRANGER: Address = ("stranger", 9)
BATCH, BATCH_NS = 10, 5 * NS_PER_MS
"""2,000 datagrams a second."""
MOST_ENTRIES = 1000
"""Entries of any table or queue of link and guard."""
MOST_BYTES = 3_000_000
ROUNDS = 8
"""Flights with one program."""
_FLYABLE_S = 15.0
_AT_REST = (Phase.WAITING, Phase.RELEASED, Phase.ENDED)


class HostileFlight:
    """One flight, and the datagrams that are mixed into it."""

    def __init__(
        self, seed: int, autopilot: AutopilotName, kind: ActionKind, *, share: int = 300
    ) -> None:
        """``share`` datagrams come in each of the three parts of a flight."""
        self._share = share
        self._draw = Random(f"{autopilot} {kind} {seed}")
        self._source = Datagrams(self._draw)
        self.fed = 0
        self.flights = self.reboots = self.refused_starts = 0
        self._last: list[bytes] = []
        """The datagrams that were fed last, for a failure; so is what the guard has told."""
        self._told: deque[str] = deque(maxlen=12)
        self._make = lambda: OutputFlight(autopilot, kind)
        self._begin()

    def _begin(self) -> None:
        self.flight = self._make()
        self._judge = WireJudge(self.flight)
        self._acted_ns: int | None = None
        self._phase = Phase.WAITING
        self._read = 0

    # --- the flight

    def run(self, count: int) -> None:
        """Feed ``count`` datagrams in rounds; raises FuzzError."""
        try:
            while self.fed < count:
                self._connect(min(500, count // 8))
                self._make_flyable()
                for _ in range(ROUNDS):
                    if self.fed >= count:
                        break
                    share = min(self._share, (count - self.fed) // 3)
                    self._source.focus_on_some()
                    self._feed(share // 2, self._source.own)
                    self._act()  # which may be obeyed, or not
                    self._feed(share // 2, self._source.own)
                    self._make_flyable()
                    self._engage()
                    self._feed_strangers(share)
                    self._feed(share, self._source.own)
                    self._make_flyable()
                self._judge_memory()
        except Exception as error:
            told = "; ".join(self._told)
            described = f"{type(error).__name__}: {error}; {self.flight.describe()}; told: {told}"
            raise failure(described, self._last) from error

    def _connect(self, count: int) -> None:
        """The vehicle is looked for; several may be heard, which ends the program in order."""
        self._begin()
        try:
            self._feed(count, self._source.own)
            self._until(lambda: self.flight.link.vehicle is not None, 4.0)
        except PeerError:
            self.refused_starts += 1
            self._begin()

    def _feed_strangers(self, count: int) -> None:
        """Nobody but the vehicle can end a flight."""
        self._feed(count, self._source.foreign, sender=None)
        assert self._phase is Phase.FLYING, "strangers have ended the flight"

    def _act(self) -> None:
        self.flight.act("engage")
        self._acted_ns = self.flight.clock.now_ns()

    def _engage(self) -> None:
        for _ in range(4):  # what is pretended to be wrong may last for two seconds
            self._act()
            if self._until(lambda: self._phase is Phase.FLYING, 1.5):
                break
        assert self._phase is Phase.FLYING, "an act does not engage"
        self.flights += 1
        self._advance(self._draw.choice((0, 20, 300)))

    def _make_flyable(self) -> None:
        """Let only the vehicle talk until forged state is forgotten."""
        if not self._is_flyable():
            self.reboots += 1
            self.flight.vehicle.reboot()
            assert self._is_flyable(), "it cannot be flown any more"

    def _is_flyable(self) -> bool:
        flight = self.flight
        self._until(lambda: self._phase in _AT_REST, 9.0)
        if self._phase not in _AT_REST:  # held without a receiver: whoever lands it ends that
            flight.command(400, 0.0, 21196.0)
            self._until(lambda: self._phase in _AT_REST, 6.0)
        assert self._phase in _AT_REST, "a flight does not end"
        end = WireEnd(42, 190)
        flight.up.send(end.pack(end.mav.param_request_list_encode(1, 1)))
        self._advance(50)
        flight.put_in_air()
        return self._until(self._is_ready, _FLYABLE_S)

    def _is_ready(self) -> bool:
        """An engage would be obeyed, as far as the link and the inputs are concerned."""
        self.flight.link.receive()
        guard, link = self.flight.guard.guard, self.flight.link.snapshot()
        assert guard is not None
        if link.status is None or link.problem is not None:
            return False
        is_flown = link.status.armed and not link.status.is_failsafe
        is_fresh = guard._chunks.problem(self.flight.clock.now_ns()) is None
        return is_flown and is_fresh and link.status.mode == self.flight.vehicle.ap.mode_name

    # --- time

    def _feed(
        self, count: int, make: Callable[[], bytes], sender: Address | None = VEHICLE
    ) -> None:
        network = self.flight.network
        for _ in range(0, count, BATCH):
            self._last = [make() for _ in range(BATCH)]
            for data in self._last:
                place = sender or self._draw.choice((VEHICLE, STRANGER))
                network.strangers.append(Received(data, self.flight.clock.now_ns(), place))
            self.fed += BATCH
            self._advance(BATCH_NS // NS_PER_MS)

    def _advance(self, ms: int) -> None:
        """Let time pass, and look at everything that happened."""
        flight, clock = self.flight, self.flight.clock
        clock.sleep_until_ns(clock.now_ns() + ms * NS_PER_MS)
        self._judge.read()
        self._source.heard.extend(data for _, data in flight.down.sent[-4:])
        for report in flight.guard_port.reports:
            if isinstance(report, GuardTick):
                self._follow(report)
            elif isinstance(report, str):
                self._told.append(report)
        del flight.guard_port.reports[:-1], flight.down.sent[:], flight.up.sent[:]
        flight.sink.events.clear()
        del flight.samples[:-1]

    def _follow(self, tick: GuardTick) -> None:
        """A flight begins by an act alone, which counts once and not for long."""
        before, self._phase = self._phase, tick.phase
        if before in _AT_REST and tick.phase not in _AT_REST:
            assert self._acted_ns is not None, f"{tick.phase} without an act"
            assert tick.sent_ns - self._acted_ns <= ACT_TIMEOUT_NS + 100 * NS_PER_MS
            self._acted_ns = None
        if tick.phase is not Phase.FLYING:
            assert tick.trace is None, f"the policy's sticks in {tick.phase}"
        if tick.phase in _AT_REST:
            assert tick.sent is None, f"sticks in {tick.phase}"

    def _until(self, condition: Callable[[], bool], within_s: float) -> bool:
        for _ in range(round(within_s * 50)):
            if condition():
                return True
            self._advance(20)
        return condition()

    # --- memory

    def _judge_memory(self) -> None:
        """Every table of link and guard is bounded."""
        flight = self.flight
        harness = (
            *(flight.network, flight.clock, flight.guard_port, flight.vehicle, flight),
            *(flight.sink, flight.sink.events),
        )
        total = 0
        for item in _reachable([flight.link, flight.guard, flight.view], harness):
            total += sys.getsizeof(item)
            if isinstance(item, dict | set | deque):
                assert len(item) <= MOST_ENTRIES, f"{len(item)} entries: {str(item)[:300]}"
        assert total <= MOST_BYTES, f"link and guard hold {total} bytes"


def _reachable(roots: list[object], harness: tuple[object, ...]) -> list[object]:
    """Everything that these hold, without classes, modules and code, and without the harness."""
    seen = {id(item) for item in harness}
    found: list[object] = []
    pending = list(roots)
    fixed = (type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType)
    while pending:
        item = pending.pop()
        if id(item) in seen or isinstance(item, fixed):
            continue
        seen.add(id(item))
        found.append(item)
        pending += gc.get_referents(item)
    return found
