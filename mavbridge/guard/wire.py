"""Messages between the flight process and the guard, as bytes.

Little-endian structures where they come at the rates of the loops, else pickles: one process has
started the other, and nobody else has an end of the channel.
"""

import io
import pickle
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

from mavbridge.core.address import SocketAddress
from mavbridge.core.reasons import Reason
from mavbridge.core.vehicle import (
    ACTION_CLASSES,
    Action,
    ActionTrace,
    ForwardedPacket,
    LinkStats,
    Reading,
    Sample,
    Sticks,
    Telemetry,
)
from mavbridge.guard.chunks import Chunk
from mavbridge.guard.settings import FlightSettings, GuardSettings
from mavbridge.guard.values import EndRequest, OperatorCommand, Outcome, Phase

_CHUNK = struct.Struct("<cBqqqqqqqqH")
_TICK = struct.Struct("<cqqqqqqqB?iBBB20d")
_QUANTITIES = Telemetry._fields
_SAMPLES = tuple(struct.Struct(f"<Bqq{count}d") for count in (4, 3, 3, 3, 3, 1))
"""By quantity: its number, arrival, delay, and the values."""
_PHASES = tuple(Phase)
_CLASSES = tuple(ACTION_CLASSES.values())
_IS_SLOT, _IS_COASTING, _HAS_TRACE, _HAS_SENT = 1, 2, 4, 8
_NOTHING = (0.0,) * 4
_PICKLE = b"S"
_MALFORMED = (
    *(struct.error, pickle.UnpicklingError, EOFError),
    *(ValueError, TypeError, LookupError, AttributeError),
)
"""Errors of the decoders for bytes that no encoder has made."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardTick:
    """One send of the guard, or one slot in which it had nothing to send."""

    index: int
    due_ns: int
    woke_ns: int
    decided_ns: int
    """The moment that the sticks were decided for: the slot, or when a chunk was seen."""
    sent_ns: int
    """After the sticks were handed to the kernel."""
    missed_slots: int
    is_slot: bool
    is_coasting: bool
    chunk_serial: int | None
    trace: ActionTrace | None
    sent: Action | None
    """As sent; None when released, or when nothing was sent."""
    phase: Phase
    reason: Reason | None
    """Why the policy does not fly; None while it does."""
    starting_ns: int = 0
    """All has been ready since then: the policy gets the sticks with its first chunk after a reset
    from then on; 0 where it has them, or all is not ready."""


class Samples(NamedTuple):
    """Readings of the vehicle, in order of arrival."""

    samples: tuple[Sample, ...]


class Packets(NamedTuple):
    """Packets of the vehicle, in order of arrival, for a recorder."""

    packets: tuple[ForwardedPacket, ...]


class GuardStatus(NamedTuple):
    """The vehicle's word about itself; sent when it changes."""

    autopilot: str
    mode: str | None
    armed: bool
    is_landed: bool | None
    rc_channels_us: tuple[int, ...]
    rc_sticks: Sticks | None
    has_position: bool = False
    """The estimator has a position that may be trusted, and the policy takes one."""


class GuardMessage(NamedTuple):
    """A line for the user."""

    text: str


class LastWords(NamedTuple):
    """What the flight process sends the vehicle if the guard dies; replaces the words before."""

    phase: Phase
    """That of the guard when it prepared them."""
    mode: str | None
    """The safe mode that they ask for."""
    receiver: SocketAddress | None
    """Address for the datagrams; None on a stream."""
    brings_file: bool
    """The open socket or port of the link comes with this message."""
    packets: tuple[tuple[int, bytes], ...]
    """Each with its delay in ns from the death; none: nothing is held, nothing is to be said."""


class GuardError(NamedTuple):
    """The guard ends because of this."""

    kind: Literal["user", "peer", "bug"]
    text: str


class NoChunk(NamedTuple):
    """Why the flight process cannot compute a chunk now."""

    reason: Reason


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardSummary:
    """Last message of a guard that ends in order."""

    autopilot: str
    link: LinkStats
    failure: Reason | None
    """Why there was no flight, or None."""
    outcome: Outcome
    params: dict[str, float]
    """The vehicle's parameters that matter for a flight, by name, as far as they were read."""
    dropped_messages: int
    """Messages to the flight process that did not fit into its queue."""
    dropped_packets: int
    """Packets that did not fit into the pipe of the telemetry log."""


ToGuard: TypeAlias = GuardSettings | FlightSettings | Chunk | NoChunk | OperatorCommand | EndRequest
FromGuard: TypeAlias = (
    Samples
    | Packets
    | GuardTick
    | GuardStatus
    | GuardMessage
    | LastWords
    | GuardError
    | GuardSummary
)

_TO_GUARD = (GuardSettings, FlightSettings, NoChunk, str, EndRequest)


def encode_to_guard(message: ToGuard) -> bytes:
    """One message of the flight process."""
    if not isinstance(message, Chunk):
        return _PICKLE + pickle.dumps(message)
    stamps = (*message[:7], message.reset_ns)
    count = len(message.actions)
    values = [value for action in message.actions for value in action]
    kind = _CLASSES.index(type(message.actions[0])) if count else 0
    return _CHUNK.pack(b"C", kind, *stamps, count) + struct.pack(f"<{4 * count}d", *values)


def decode_to_guard(data: bytes) -> ToGuard:
    """Inverse of ``encode_to_guard``; raises ValueError for anything else."""
    try:
        message: ToGuard = _decode_chunk(data) if data[:1] == b"C" else _unpickled(data, _TO_GUARD)
    except _MALFORMED as error:
        raise ValueError(f"not a message to the guard: {data[:16]!r}") from error
    return message


def encode_from_guard(message: FromGuard) -> bytes:
    """One message of the guard."""
    match message:
        case GuardTick():
            return _encode_tick(message)
        case Samples(samples):
            return encode_samples(samples)
    return _PICKLE + pickle.dumps(message)


def decode_from_guard(data: bytes) -> FromGuard:
    """Any message of the guard; raises ValueError for anything else."""
    try:
        match data[:1]:
            case b"T":
                return _decode_tick(data)
            case b"R":
                return Samples(tuple(decode_samples(data)))
        message: FromGuard = _unpickled(data, get_args(FromGuard))
    except _MALFORMED as error:
        raise ValueError(f"not a message of the guard: {data[:16]!r}") from error
    return message


class _Unpickler(pickle.Unpickler):
    """Imports nothing that the guard does not have: numpy, say, would stop it for long."""

    def find_class(self, module: str, name: str) -> Any:
        """Return a class of ours, or raise UnpicklingError."""
        if module.split(".")[0] not in ("mavbridge", "pathlib"):
            raise pickle.UnpicklingError(f"{module}.{name} is no part of a message")
        return super().find_class(module, name)


def _unpickled(data: bytes, classes: tuple[type, ...]) -> Any:
    message = _Unpickler(io.BytesIO(data[1:])).load() if data[:1] == _PICKLE else None
    if not isinstance(message, classes):
        raise ValueError("unknown kind")  # noqa: TRY004 - as everything else that is no message
    return message


def _decode_chunk(data: bytes) -> Chunk:
    _, kind, *stamps, count = _CHUNK.unpack_from(data)
    serial, attitude_ns, velocity_ns, image_ns, computed_ns, first_ns, step_ns, reset_ns = stamps
    make = _CLASSES[kind]
    values = struct.unpack(f"<{4 * count}d", data[_CHUNK.size :])
    return Chunk(
        serial=serial,
        attitude_ns=attitude_ns,
        velocity_ns=velocity_ns,
        image_ns=image_ns,
        computed_ns=computed_ns,
        first_ns=first_ns,
        step_ns=step_ns,
        actions=tuple(make(*values[4 * k : 4 * k + 4]) for k in range(count)),
        reset_ns=reset_ns,
    )


def _encode_tick(tick: GuardTick) -> bytes:
    flags = (
        _IS_SLOT * tick.is_slot
        | _IS_COASTING * tick.is_coasting
        | _HAS_TRACE * (tick.trace is not None)
        | _HAS_SENT * (tick.sent is not None)
    )
    trace, serial = tick.trace, tick.chunk_serial
    stages = _NOTHING * 4
    if trace is not None:
        stages = (*trace.raw, *trace.clipped, *trace.slewed, *trace.smoothed)
    packed = _TICK.pack(
        b"T",
        *(tick.index, tick.due_ns, tick.woke_ns, tick.decided_ns, tick.sent_ns, tick.starting_ns),
        *(0 if serial is None else serial, flags, serial is not None, tick.missed_slots),
        _PHASES.index(tick.phase),
        0 if trace is None else _CLASSES.index(type(trace.raw)),
        0 if tick.sent is None else _CLASSES.index(type(tick.sent)),
        *stages,
        *(tick.sent or _NOTHING),
    )
    return packed if tick.reason is None else packed + pickle.dumps(tick.reason)


def _decode_tick(data: bytes) -> GuardTick:
    _, index, due_ns, woke_ns, decided_ns, sent_ns, starting_ns, *rest = _TICK.unpack_from(data)
    serial, flags, has_chunk, missed, phase, traced, sent_kind, *values = rest
    fours = [values[4 * k : 4 * k + 4] for k in range(5)]
    raw, clipped, slewed, smoothed = (_CLASSES[traced](*four) for four in fours[:4])
    trace = ActionTrace(raw=raw, clipped=clipped, slewed=slewed, smoothed=smoothed)
    sent = _CLASSES[sent_kind](*fours[4])
    reason: Reason | None = None
    if len(data) > _TICK.size:
        reason = _unpickled(_PICKLE + data[_TICK.size :], (Reason,))
    return GuardTick(
        index=index,
        due_ns=due_ns,
        woke_ns=woke_ns,
        decided_ns=decided_ns,
        sent_ns=sent_ns,
        missed_slots=missed,
        is_slot=bool(flags & _IS_SLOT),
        is_coasting=bool(flags & _IS_COASTING),
        starting_ns=starting_ns,
        chunk_serial=serial if has_chunk else None,
        trace=trace if flags & _HAS_TRACE else None,
        sent=sent if flags & _HAS_SENT else None,
        phase=_PHASES[phase],
        reason=reason,
    )


def encode_samples(samples: Iterable[Sample]) -> bytes:
    """Readings of the vehicle, in order of arrival."""
    parts = [b"R"]
    for name, (arrived_ns, values, delay_ns) in samples:
        number = _QUANTITIES.index(name)
        parts.append(_SAMPLES[number].pack(number, arrived_ns, delay_ns, *values))
    return b"".join(parts)


def decode_samples(data: bytes) -> Iterator[Sample]:
    """Inverse of ``encode_samples``, where nothing else can come."""
    at = 1
    while at < len(data):
        layout = _SAMPLES[data[at]]
        number, arrived_ns, delay_ns, *values = layout.unpack_from(data, at)
        yield Sample(_QUANTITIES[number], Reading(arrived_ns, tuple(values), delay_ns))
        at += layout.size
