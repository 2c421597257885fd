"""Encoding of the messages between the flight process and the guard.

Samples and chunks, which lie between an attitude and its command, are little-endian structures; all
others are pickles. Pickles are safe here: one process has started the other, and no third one has
an end of the channel.
"""

import io
import pickle
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from itertools import chain
from typing import Any, BinaryIO, NamedTuple, TypeAlias, get_args

from mavbridge.core.address import SocketAddress
from mavbridge.core.errors import ExitCode, MavbridgeError, PeerError, UserError
from mavbridge.core.reasons import Reason
from mavbridge.core.ticks import GuardTick
from mavbridge.core.vehicle import (
    ACTION_CLASSES,
    ForwardedPacket,
    LinkStats,
    Reading,
    Sample,
    Sticks,
    Telemetry,
)
from mavbridge.guard.chunks import Chunk
from mavbridge.guard.values import (
    EndRequest,
    FlightSettings,
    GuardOutcome,
    GuardSettings,
    OperatorCommand,
    Phase,
)

_CHUNK = struct.Struct("<cBqqqqqqqqH")
_ACTION = struct.Struct("<4d")
_QUANTITIES = Telemetry._fields
_SAMPLES = tuple(struct.Struct(f"<Bqq{count}d") for count in (4, 3, 3, 3, 3, 1))
"""Layout of a sample by quantity: index, arrival, delay, values."""
_CLASSES = tuple(ACTION_CLASSES.values())
_MALFORMED = (
    *(struct.error, pickle.UnpicklingError, EOFError),
    *(ValueError, TypeError, LookupError, AttributeError),
)
"""Errors of the decoders on malformed bytes."""


class Samples(NamedTuple):
    """Readings of the vehicle, in order of arrival."""

    samples: tuple[Sample, ...]


class Packets(NamedTuple):
    """Packets of the vehicle, in order of arrival, for a recorder."""

    packets: tuple[ForwardedPacket, ...]


class GuardStatus(NamedTuple):
    """Vehicle status; sent when it changes."""

    autopilot: str
    mode: str | None
    armed: bool
    is_landed: bool | None
    rc_channels_us: tuple[int, ...]
    rc_sticks: Sticks | None
    has_position: bool = False
    """True if the policy takes a position and the estimator has a valid one."""


class LastWords(NamedTuple):
    """Packets for the flight process to send if the guard dies; replaces the previous ones."""

    phase: Phase
    """Phase of the guard when it prepared the packets."""
    mode: str | None
    """Safe mode that the packets request."""
    receiver: SocketAddress | None
    """Address for the datagrams; None on a stream."""
    brings_file: bool
    """True if the link's open socket or port comes with this message."""
    packets: tuple[tuple[int, bytes], ...]
    """Delay after the death [ns] and bytes of each packet; empty: nothing is held, send nothing."""


NO_WORDS = LastWords(Phase.WAITING, None, None, brings_file=False, packets=())
"""Last words of a guard that has held nothing yet."""


class GuardDiedError(MavbridgeError):
    """The guard process exited without its summary, or stands still."""

    exit_code = ExitCode.FAULT


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardSummary:
    """Last message of a guard that ends normally."""

    link: LinkStats
    outcome: GuardOutcome
    params: dict[str, float]
    """The vehicle's flight-relevant parameters that have been read, by name."""
    dropped_messages: int
    """Messages dropped because the flight process's queue was full."""
    dropped_packets: int
    """Packets dropped because the telemetry log's pipe was full."""


ToGuard: TypeAlias = FlightSettings | Chunk | Reason | OperatorCommand | EndRequest
"""A reason tells why the flight process cannot compute a chunk now."""
FromGuard: TypeAlias = (
    Samples
    | Packets
    | GuardTick
    | GuardStatus
    | str
    | LastWords
    | GuardSummary
    | UserError
    | PeerError
    | GuardDiedError
)
"""Text is one line for the user; an error ends the guard."""

_TO_GUARD = (FlightSettings, Chunk, Reason, str, EndRequest)
_FROM_GUARD = get_args(FromGuard)


def encode(message: ToGuard | FromGuard | GuardSettings) -> bytes:
    """Encode a message of either process, or the settings that the guard starts with."""
    if isinstance(message, Samples):
        return _encode_samples(message)
    if isinstance(message, Chunk):
        return _encode_chunk(message)
    file = io.BytesIO()
    _Pickler(file).dump(message)
    return file.getvalue()


def read_settings(file: BinaryIO) -> GuardSettings:
    """Read the settings of the guard process; what is behind them is not waited for."""
    settings: GuardSettings = _Unpickler(file).load()
    return settings


def decode_to_guard(data: bytes) -> ToGuard:
    """Decode a message of the flight process; raise ValueError if it is malformed."""
    message: ToGuard = _decode(data, _TO_GUARD)
    return message


def decode_from_guard(data: bytes) -> FromGuard:
    """Decode a message of the guard; raise ValueError if it is malformed."""
    message: FromGuard = _decode(data, _FROM_GUARD)
    return message


def _decode(data: bytes, kinds: tuple[type, ...]) -> Any:
    message: object = None
    try:
        if data[:1] == b"C":
            message = _decode_chunk(data)
        elif data[:1] == b"R":
            message = Samples(tuple(_decode_samples(data)))
        else:  # a pickle, which begins with its version
            message = _Unpickler(io.BytesIO(data)).load()
    except _MALFORMED as error:
        raise ValueError(f"not a message: {data[:16]!r}") from error
    if not isinstance(message, kinds):
        raise ValueError(f"not a message of that process: {message!r}")  # noqa: TRY004 - malformed
    return message


def _encode_chunk(chunk: Chunk) -> bytes:
    stamps = (*chunk[:7], chunk.reset_ns)
    count = len(chunk.actions)
    kind = _CLASSES.index(type(chunk.actions[0])) if count else 0
    values = struct.pack(f"<{4 * count}d", *chain.from_iterable(chunk.actions))
    return _CHUNK.pack(b"C", kind, *stamps, count) + values


def _decode_chunk(data: bytes) -> Chunk:
    _, kind, *stamps, reset_ns, count = _CHUNK.unpack_from(data)
    if len(data) != _CHUNK.size + count * _ACTION.size:
        raise ValueError("a chunk of another length")
    actions = _ACTION.iter_unpack(memoryview(data)[_CHUNK.size :])
    return Chunk._make((*stamps, tuple(map(_CLASSES[kind]._make, actions)), reset_ns))


def _encode_samples(message: Samples) -> bytes:
    parts = [b"R"]
    for name, (arrived_ns, values, delay_ns) in message.samples:
        number = _QUANTITIES.index(name)
        parts.append(_SAMPLES[number].pack(number, arrived_ns, delay_ns, *values))
    return b"".join(parts)


def _decode_samples(data: bytes) -> Iterator[Sample]:
    at = 1
    while at < len(data):
        layout = _SAMPLES[data[at]]
        number, arrived_ns, delay_ns, *values = layout.unpack_from(data, at)
        yield Sample(_QUANTITIES[number], Reading(arrived_ns, tuple(values), delay_ns))
        at += layout.size


class _Pickler(pickle.Pickler):
    """Pickler that writes texts and numbers of a user's contract as plain ones.

    Scalars of numpy are such numbers, members of a StrEnum such texts. Members of our own Enums
    are written by value: Python 3.11.2 (Debian 12) would write ``getattr``.
    """

    def reducer_override(self, value: Any) -> Any:
        """Return how to rebuild an Enum's member, or a scalar of another type; NotImplemented."""
        if not type(value).__module__.startswith("mavbridge."):
            for plain in (str, int, float):
                if isinstance(value, plain):
                    return plain, (str.__str__(value) if plain is str else plain(value),)
        if isinstance(value, Enum):
            return type(value), (value.value,)
        if type(value).__module__ != "numpy" or getattr(value, "ndim", None) != 0:
            return NotImplemented
        item = value.item()
        return type(item), (item,)


class _Unpickler(pickle.Unpickler):
    """Unpickler for our own classes: importing others, such as numpy, would stall the guard."""

    def find_class(self, module: str, name: str) -> Any:
        """Return a class of our own, or raise UnpicklingError."""
        if module == "builtins" and name in ("bool", "int", "float", "str"):
            return super().find_class(module, name)
        found = None
        if module.split(".")[0] in ("mavbridge", "pathlib") and "." not in name:
            found = super().find_class(module, name)
        if not isinstance(found, type):
            raise pickle.UnpicklingError(f"{module}.{name} is no part of a message")
        return found
