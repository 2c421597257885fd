"""Replay of a flight's guard and link with the recorded bytes, chunks and times.

``GuardLoop`` and ``MavlinkLink`` run as in the flight; the socket, the channel to the flight
process and the clock are replaced. The recording supplies the times at which the guard woke,
decided and had sent its sticks, the received bytes, and the newest chunk at each pass. Requests of
the operator or the flight process are derived from the phases, refused or absent chunks from the
reason for the end.
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, zip_longest

from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, Kind, Reason, because
from mavbridge.core.records import Solve, Tick
from mavbridge.core.ticks import GuardTick
from mavbridge.flight.history import ActionFrame
from mavbridge.flight.plan import FlightPlan, plan_flight
from mavbridge.flight.policy_loop import chunk_of
from mavbridge.flight.settings import link_settings
from mavbridge.guard.chunks import GRACE_PERIODS, LEAST_GRACE_NS, MAX_REFUSED, Chunk
from mavbridge.guard.guard import Guard, GuardInput
from mavbridge.guard.loop import GuardLoop
from mavbridge.guard.values import EndRequest, FlightSettings, OperatorCommand, Phase
from mavbridge.guard.wire import ToGuard, decode_from_guard, encode
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.transport.connection import (
    REOPEN_NS,
    Address,
    Received,
    Transport,
    TransportDownError,
)
from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.network import VEHICLE
from mavbridge.simulation.replay.recording import RecordedPacket, ReplaySource

PREPARE_NS = 10 * NS_PER_MS
"""Longest time between two polls of the link, as while no policy is loaded."""
_OWN_ENDINGS = (
    *(Code.SIGNAL, Code.COURSE_DONE, Code.POLICY_STOPPED),
    *(Code.POLICY_FAILED, Code.CAMERA_FAILED, Code.HANGS),
    *(Code.TOLD_TO_END, Code.FLIGHT_PROCESS_DIED),
)
"""Reasons for which the guard was asked to end."""
_OF_SENDERS = frozenset((Code.MOVED, Code.MOVED_AT_REST, Code.REPLACED))


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardStep:
    """One recorded pass of the guard and its repetition."""

    recorded: Tick
    replayed: GuardTick | None
    """None: the replayed pass neither sent nor reported."""
    given: tuple[tuple[int, GuardInput], ...]
    """Times and inputs of the guard's steps since the pass before, up to that of this pass, if any.
    On the way into a flight, and for an absence, a pass has no tick of its own."""


def unrepeatable(ticks: Sequence[Tick]) -> Iterator[str]:
    """Yield what the replayed guard cannot repeat, for want of the senders of the packets."""
    for reason in (tick.release_reason for tick in ticks):
        if reason is not None and not _OF_SENDERS.isdisjoint(reason.codes):
            yield f"a recording lacks the senders of packets, so this is not repeated: {reason}"
            return


def recorded_plan(source: ReplaySource) -> FlightPlan:
    """Return the plan of the recorded flight."""
    return plan_flight(source.config, source.contract, is_dual=source.meta.mode == "dual")


def replay_guard(source: ReplaySource) -> list[GuardStep]:
    """Replay the recorded chunks through the guard. Return one step for each recorded tick."""
    ticks = source.ticks
    clock = SteppedClock(
        min(source.packets[0].arrived_ns if source.packets else ticks[0].woke_ns, ticks[0].woke_ns)
    )
    transport = _RecordedTransport(clock, source.packets, source.requested_ns)
    link = _link(source, clock, transport)
    port = _RecordedPort(clock)
    given: list[tuple[int, GuardInput]] = []
    loop = GuardLoop(clock, link, port, watch_input=lambda *step: given.append(step))
    settings = recorded_plan(source).guard
    port.inbox.append(encode(settings))
    # The grid begins when the guard gets its settings.
    port.begin_ns = ticks[0].due_ns - ticks[0].index * settings.stick_period_ns
    steps: list[GuardStep] = []
    codes: tuple[Code, ...] = ()
    absences = deque(_absences(source, settings.chunk_period_ns))
    for tick, chunk, act, stop in _arrivals(source):
        at_ns = tick.decided_ns or tick.woke_ns
        absence: Reason | None = None
        while absences and absences[0][0] <= at_ns:
            told_ns, absence = absences.popleft()
            if told_ns < at_ns:
                _keep_link(link, clock, transport, min(told_ns, tick.woke_ns, tick.due_ns - 1))
                told_ns = clock.now_ns()
            if told_ns < tick.due_ns:  # else in the pass of the tick
                port.inbox.append(encode(absence))
                loop.step()
                absence = None
        if steps and steps[-1].recorded.phase == tick.phase == Phase.PREPARING:
            for _ in _arrived(link, clock, transport, min(tick.woke_ns, tick.due_ns)):
                loop.step()
        _keep_link(link, clock, transport, tick.woke_ns)
        port.decided_ns, transport.sent_ns = at_ns, tick.sent_ns
        is_neutral_refused = source.meta.keeps_neutral and tick.lacks_neutral
        transport.is_refusing = tick.is_refused or is_neutral_refused
        before, codes = codes, tick.release_reason.codes if tick.release_reason else ()
        transport.is_lost = Code.CONNECTION_LOST in codes and Code.CONNECTION_LOST not in before
        messages: tuple[ToGuard | None, ...] = (chunk, absence, act, stop)
        port.inbox += [encode(each) for each in messages if each is not None]
        loop.step()
        steps.append(GuardStep(recorded=tick, replayed=port.take_tick(), given=tuple(given)))
        given.clear()
    return steps


def _keep_link(
    link: MavlinkLink, clock: SteppedClock, transport: "_RecordedTransport", until_ns: int
) -> None:
    """Let the link receive and request between two ticks."""
    for _ in _arrived(link, clock, transport, until_ns):
        link.receive()
        link.service()


def _arrived(
    link: MavlinkLink, clock: SteppedClock, transport: "_RecordedTransport", until_ns: int
) -> Iterator[None]:
    """Advance the clock to ``until_ns``; yield at each arrival and request before, or soon.

    It also services the link just before each arrival, since the packet may be the answer to a
    request: a vehicle selected a moment later would still be ignored.
    """
    while clock.now_ns() < until_ns:
        arrival_ns = transport.next_arrival_ns or until_ns
        if arrival_ns - 1 > clock.now_ns():
            clock.sleep_until_ns(min(arrival_ns - 1, transport.stop_ns(until_ns)))
            if clock.now_ns() < until_ns:
                link.service()
        clock.sleep_until_ns(min(arrival_ns, transport.stop_ns(until_ns)))
        if clock.now_ns() < until_ns:
            yield


def replay_other(
    steps: Sequence[GuardStep],
    settings: FlightSettings,
    chunks: Mapping[int, Chunk],
) -> Iterator[GuardTick | None]:
    """Replay other chunks or settings through the guard. Yield the tick of each of ``steps``; None
    where the guard had nothing to do.

    The vehicle's answers are those to the recorded sticks, so the link is not run; its recorded
    snapshots are used. The resulting sticks are those of the policy's trace, before the message.
    """
    first = steps[0].recorded
    guard = Guard(settings, first.due_ns - first.index * settings.stick_period_ns)
    for step in steps:
        tick: GuardTick | None = None
        for at_ns, given in step.given:
            chunk = None if given.chunk is None else chunks.get(given.chunk.serial)
            tick = guard.step(at_ns, replace(given, chunk=chunk, command_fault=None)).tick
        if step.recorded.is_refused:
            guard.unsent()
        yield tick


def _arrivals(
    source: ReplaySource,
) -> Iterator[tuple[Tick, Chunk | None, OperatorCommand | None, EndRequest | None]]:
    """Yield each tick, and the messages of the flight process that the guard had got by then.

    A tick that flies a chunk names it. Before a flight, a chunk counts from the end of its solve,
    but the first one that flies only from its tick on: it may have been on its way before.
    """
    frame, solves = ActionFrame(source.contract), iter(source.solves)
    waiting = next(solves, None)
    before: Tick | None = None
    for tick, after in zip_longest(source.ticks, source.ticks[1:]):
        newest: Solve | None = None
        while waiting is not None and _is_seen(waiting, tick, after):
            newest, waiting = waiting, next(solves, None)
        chunk = None if newest is None else chunk_of(newest, frame)
        yield tick, chunk, _act(before, tick, is_arm=source.config.arm), _stop(before, tick)
        before = tick


def _absences(source: ReplaySource, period_ns: int) -> Iterator[tuple[int, Reason]]:
    """Yield when and why the guard was told that there is no usable chunk.

    Such a pass has no tick, but the reason for the end tells of it: the last malformed chunks come
    with the tick that ends the flight, another absence when it ends the grace at that tick. An end
    between two slots needs a message of the flight process, or has other causes: one more absence
    does not change those.
    """
    shortening_ns = max(LEAST_GRACE_NS, GRACE_PERIODS * period_ns) - period_ns
    taken_ns = serial = 0
    for before, tick in pairwise(source.ticks):
        if before.chunk_serial is not None and before.chunk_serial != serial:
            taken_ns, serial = before.decided_ns or before.woke_ns, before.chunk_serial
        reason, at_ns = tick.release_reason, tick.decided_ns or tick.woke_ns
        if before.phase != "flying" or tick.phase == "flying" or reason is None:
            continue
        said = next(iter(reason.inner), None)
        if reason.code is Code.UNUSABLE_CHUNKS and said is not None:
            yield from ((at_ns - left, said) for left in reversed(range(MAX_REFUSED)))
            continue
        if reason.code in (Code.LATE, Code.PAST_HORIZON):
            if any(serial < each.serial and each.computed_ns < at_ns for each in source.solves):
                said = said or because(Code.NO_CHUNK)  # they were too old
            if said is not None:
                yield max(taken_ns + 1, at_ns - 1 - shortening_ns), said
        if not tick.is_slot:
            yield at_ns, said or because(Code.NO_CHUNK)


def _is_seen(solve: Solve, tick: Tick, after: Tick | None) -> bool:
    if tick.chunk_serial is not None:
        return solve.serial <= tick.chunk_serial
    is_next = after is not None and after.chunk_serial == solve.serial
    return solve.computed_ns <= tick.woke_ns and not is_next


def _act(before: Tick | None, tick: Tick, *, is_arm: bool) -> OperatorCommand | None:
    """Return the operator's key, derived from a change of phase."""
    was = None if before is None else before.phase
    if was in ("waiting", "released") and tick.phase in ("preparing", "flying"):
        return "engage"  # no other act in a pass in which `--arm` or the engage switch acts
    is_called_off = is_arm and tick.release_reason == because(Code.NOT_ENGAGED)
    if is_called_off and was == tick.phase == "waiting":
        return "release"  # `--arm` waits for the link alone
    is_ended = was in ("preparing", "flying") and tick.phase != was
    is_ended |= (was, tick.phase) == ("holding", "leaving")
    if is_ended and tick.release_reason and tick.release_reason.code is Code.OPERATOR:
        return "release"
    return None


def _stop(before: Tick | None, tick: Tick) -> EndRequest | None:
    """Return the flight process' request to end, derived from a change of phase."""
    was = None if before is None else before.phase
    reason = tick.release_reason
    if reason is not None and reason.code is Code.THEN:
        reason = reason.inner[0]
    if tick.phase != was and reason is not None and reason.code in _OWN_ENDINGS:
        return EndRequest(reason, "fault" if reason.kind is Kind.FAULT else "signal")
    if tick.phase == Phase.ENDED != was:  # the second of two stops has no effect
        return EndRequest(reason=because(Code.SIGNAL))
    return None


def _link(
    source: ReplaySource, clock: SteppedClock, transport: "_RecordedTransport"
) -> MavlinkLink:
    config: FlyConfig = source.config
    # Use the settings from before a policy was loaded, as when the guard started.
    loops = config.rates.loops(is_dual=source.meta.mode == "dual")
    settings = replace(link_settings(config, loops), known_params=source.known_params)
    return MavlinkLink(transport, clock, settings)


class _RecordedTransport(Transport):
    """Transport that delivers recorded packets and discards sent ones."""

    def __init__(
        self, clock: SteppedClock, packets: Sequence[RecordedPacket], requested_ns: Sequence[int]
    ) -> None:
        self._clock = clock
        self._requested_ns = requested_ns
        self._packets = iter(packets)
        self._next = next(self._packets, None)
        self.sent_ns: int | None = None
        """Time at which the sticks of this pass had left."""
        self.is_refusing = False
        """True if the last recorded action was refused."""
        self.is_lost = False
        """True if the next read loses the connection."""
        self._is_down = False

    def open(self) -> None:
        """Fail after a loss unless a packet follows before the next attempt."""
        limit_ns = self._clock.now_ns() + REOPEN_NS
        if self._is_down and (self._next is None or self._next.arrived_ns >= limit_ns):
            raise TransportDownError("as in the recording")
        self._is_down = False

    @property
    def next_arrival_ns(self) -> int | None:
        """Arrival of the next packet; None after the last, and without a connection."""
        return None if self._next is None or self._is_down else self._next.arrived_ns

    def stop_ns(self, until_ns: int) -> int:
        """Return when to service the link next: a vehicle answers a request within milliseconds,
        and one that is repeated late misses its answer."""
        now_ns = self._clock.now_ns()
        place = bisect_right(self._requested_ns, now_ns)
        return min(now_ns + PREPARE_NS, until_ns, *self._requested_ns[place : place + 1])

    def drain(self) -> Iterator[Received]:
        """Yield every packet that has arrived."""
        now_ns = self._clock.now_ns()
        while self._next is not None and self._next.arrived_ns <= now_ns:
            packet, self._next = self._next, next(self._packets, None)
            yield Received(packet.data, packet.arrived_ns, VEHICLE)
        if self.is_lost:
            self.is_lost, self._is_down = False, True
            raise TransportDownError("as in the recording")

    def send(self, data: bytes, peer: Address | None = None) -> bool:
        """Advance the clock to the recorded end of sending; refuse what was refused then."""
        if self.sent_ns is not None:
            self._clock.sleep_until_ns(self.sent_ns)
            self.sent_ns = None
        return not self.is_refusing


class _RecordedPort:
    """``Port`` without a flight process; receiving advances the clock to the time of the
    decision."""

    def __init__(self, clock: SteppedClock) -> None:
        self._clock = clock
        self.inbox: list[bytes] = []
        self.begin_ns: int | None = None
        """Time at which the guard had read the flight's settings, in the next pass."""
        self.decided_ns: int | None = None
        self.is_closed = False
        self._tick: GuardTick | None = None

    def send(self, message: bytes, fd: int | None = None) -> bool:
        """Keep a tick; discard other messages, which have no reader."""
        decoded = decode_from_guard(message)
        if isinstance(decoded, GuardTick):
            self._tick = decoded
        return True

    def take_tick(self) -> GuardTick | None:
        """Return the tick since the last call, or None."""
        tick, self._tick = self._tick, None
        return tick

    def receive(self) -> list[bytes]:
        """Return the injected messages."""
        until_ns, self.begin_ns = self.begin_ns or self.decided_ns, None
        if until_ns is not None:
            self._clock.sleep_until_ns(until_ns)
        messages, self.inbox = self.inbox, []
        return messages
