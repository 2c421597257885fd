"""Hostile datagrams against the codec."""

import math
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from random import Random

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fuzz.datagrams import Datagrams
from helpers.wire import WireEnd
from mavbridge.mavlink.codec.messages import Attitude, Endpoint, RcChannels, ReceivedMessage
from mavbridge.mavlink.codec.packets import Codec

MOST_CPU_S = 5.0
"""For one datagram, to find a loop without an end. The dearest take 3 ms on an idle machine."""
MOST_SHOWN_BYTES = 4096
"""Of each datagram in a message: the guard reads no more of one."""
_SAMPLE_EVERY = 50
"""The vehicle's own packets, of which the mutations are made."""


class FuzzError(AssertionError):
    """An invariant does not hold; says by which datagrams."""


def failure(problem: object, datagrams: Iterable[bytes]) -> FuzzError:
    """The failure, with the datagrams of which one has brought it about."""
    lines = "\n".join(f"  {data[:MOST_SHOWN_BYTES].hex()}" for data in datagrams)
    return FuzzError(f"{problem}\nby one of these datagrams (hex):\n{lines}")


@contextmanager
def judging(data: bytes) -> Iterator[None]:
    """What is done with a datagram: any exception, or too long a time, is a failure."""
    start_s = time.thread_time()
    try:
        yield
    except Exception as error:
        raise failure(f"{type(error).__name__}: {error}", [data]) from error
    if time.thread_time() - start_s > MOST_CPU_S:
        raise failure(f"takes longer than {MOST_CPU_S} s", [data])


def fuzz_codec(seed: int, count: int) -> None:
    """Feed ``count`` datagrams.

    Raises:
        FuzzError: an invariant does not hold.
    """
    draw = Random(f"codec {seed}")
    source = Datagrams(draw)
    vehicle = WireEnd()
    datagrams = Codec(source_system=255)
    stream = Codec(source_system=255)
    for number in range(count):
        if number % _SAMPLE_EVERY == 0:
            source.heard.append(sample(vehicle, draw))
        data = source.own() if draw.random() < 0.7 else source.foreign()
        with judging(data):
            for message in datagrams.decode_datagram(data, ("sender", number % 20)):
                _judge(message)
            for piece in _pieces(data[:4096], draw):
                for message in stream.decode(piece):
                    _judge(message)
    for codec in (datagrams, stream):
        assert len(codec._partials) <= 16, "the unfinished packets become more"
        assert all(len(part) < 300 for part in codec._partials.values()), "one of them grows"


def sample(end: WireEnd, draw: Random) -> bytes:
    mav, boot_ms = end.mav, draw.randrange(1_000_000)
    none = (0.0,) * 3
    return end.pack(
        draw.choice(
            (
                mav.attitude_quaternion_encode(boot_ms, 1.0, 0.0, 0.0, 0.0, *none),
                mav.local_position_ned_encode(boot_ms, *none, *none),
                mav.rc_channels_encode(boot_ms, 8, *(1500,) * 8, *(0,) * 10, 255),
                mav.param_value_encode(b"RC1_MIN", 1100.0, 9, 900, 1),
                mav.statustext_encode(4, b"PreArm: something", 7, 1),
                mav.command_ack_encode(511, 0, 0, 0, 255, 191),
                mav.heartbeat_encode(2, 3, 129, 2, 4),
            )
        )
    )


def _pieces(data: bytes, draw: Random) -> Iterator[bytes]:
    """As a stream may cut it."""
    cut = draw.randrange(len(data) + 1)
    yield data[:cut]
    yield data[cut:]


def _judge(message: ReceivedMessage) -> None:
    """A body comes of a sound packet alone, and its numbers are usable."""
    if message.body is None:
        return
    body = message.body
    if message.name not in ("CURRENT_MODE", "EVENT"):  # not in the dialect of the other reader
        independent = dialect.MAVLink(None).decode(bytearray(message.packet))
        assert independent.get_type() == message.name
        assert Endpoint(independent.get_srcSystem(), independent.get_srcComponent()) == (
            message.source
        )
    if message.name != "PARAM_VALUE":  # whose bytes may be those of an integer
        for value in body:
            numbers = value if isinstance(value, tuple) else (value,)
            # A yaw rate alone may be none in a velocity target.
            is_number = [n for n in numbers if isinstance(n, float)]
            assert all(map(math.isfinite, is_number)) or message.name.startswith("POSITION_TARGET")
    if isinstance(body, Attitude):
        assert 0.9 < math.hypot(*body.ned_from_body_wxyz) < 1.1
    if isinstance(body, RcChannels):
        assert len(body.channels_us) <= 18
