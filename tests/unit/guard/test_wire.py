"""Every message between the processes arrives as it was sent."""

import math
import os
import struct
from collections.abc import Callable
from dataclasses import replace
from enum import Enum
from functools import partial
from subprocess import Popen
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.guard_facts import engagement_settings, flight_settings, stick_smoothing
from mavbridge.core.link_settings import LinkSettings
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import (
    ActionTrace,
    ForwardedPacket,
    LinkStats,
    Percentiles,
    Reading,
    Sample,
    Sticks,
)
from mavbridge.guard.chunks import Chunk
from mavbridge.guard.envelope import EnvelopeLimits
from mavbridge.guard.settings import GuardSettings
from mavbridge.guard.values import EndRequest, Outcome, Phase
from mavbridge.guard.wire import (
    FromGuard,
    GuardError,
    GuardStatus,
    GuardSummary,
    GuardTick,
    Packets,
    Samples,
    ToGuard,
    decode_from_guard,
    decode_to_guard,
    encode_from_guard,
    encode_to_guard,
)

STICKS = Sticks(0.1, -0.2, 0.3, -0.4)
FLIGHT = flight_settings(
    smoothing=stick_smoothing(max_slew_per_s=8.0, tau_s=0.05),
    envelope=EnvelopeLimits(height_m=math.inf),
    engagement=engagement_settings(then="rtl"),
)
CHUNK = Chunk(
    serial=7,
    attitude_ns=1,
    velocity_ns=2,
    image_ns=3,
    computed_ns=4,
    first_ns=5,
    step_ns=6,
    actions=(STICKS, Sticks(1e-300, -0.0, math.inf, 1.0)),
)
TICK = GuardTick(
    slot=3,
    due_ns=10,
    woke_ns=11,
    decided_ns=11,
    sent_ns=12,
    missed_slots=2,
    is_coasting=False,
    chunk_serial=7,
    trace=ActionTrace(raw=STICKS, clipped=STICKS, slewed=STICKS, smoothed=STICKS),
    sent=STICKS,
    phase=Phase.FLYING,
    reason=None,
)
STATUS = GuardStatus("ArduPilot 4.6.3", "ALT_HOLD", True, False, (1500,) * 8, STICKS, True)
STATS = LinkStats(
    messages_per_s=(("ATTITUDE_QUATERNION", 99.9), ("HEARTBEAT", 10.0)),
    lost_fraction=0.25,
    rtt_ms=Percentiles(p50=1.0, p99=2.0, p999=3.0, max=4.0),
    sent_overrides=6000,
    echo_confirmed=None,
    vehicle_clock_offset_ns=-5,
    saturated=(("pitch", 0.25), ("yaw", 0.01)),
)
SUMMARY = GuardSummary(
    autopilot="PX4",
    link=STATS,
    failure=because(Code.NO_CHUNK_SINCE_RESET, why=because(Code.NO_IMAGE)),
    outcome=Outcome(
        flights=2,
        has_left_ground=True,
        faults=1,
        end="fault",
        fault=because(Code.IMAGE_FROZEN, age_s=0.6),
    ),
    params={"RC_OVERRIDE_TIME": 0.5},
    dropped_messages=1,
    dropped_packets=2,
)
TO_GUARD: list[ToGuard] = [
    because(Code.OF_CAMERA, camera="größer", why=because(Code.NO_IMAGE)),
    GuardSettings(link=LinkSettings(connect="udp:127.0.0.1:14550"), tlog_fd=9),
    FLIGHT,
    EndRequest(reason=because(Code.HANGS, name="policy", idle_s=2.0), is_fault=True),
    "engage",
    "release",
]
FROM_GUARD: list[FromGuard] = [
    TICK,
    TICK._replace(
        slot=None, chunk_serial=None, trace=None, sent=None, reason=because(Code.NO_IMAGE)
    ),
    Samples(()),
    Samples(
        (
            Sample("velocity_ned_mps", Reading(3, (0.1, -math.inf, 1e300), -5)),
            Sample("ned_from_body_wxyz", Reading(4, (1.0, 0.2, 0.3, 0.4), 2**40)),
            Sample("height_above_home_m", Reading(2**60, (7.0,), 0)),
        )
    ),
    Packets(()),
    Packets(
        (
            ForwardedPacket(1, 2, b"\xfd" * 280),
            ForwardedPacket(3, 3, b""),
            ForwardedPacket(4, 1, b"P"),
        )
    ),
    STATUS,
    GuardStatus("none", None, False, None, (), None),
    "PreArm: Gyros inconsistent",
    GuardError("user", "another guard flies this vehicle"),
    SUMMARY,
    replace(SUMMARY, failure=None, link=replace(STATS, rtt_ms=None, lost_fraction=None)),
]


@pytest.mark.parametrize("message", TO_GUARD, ids=lambda m: type(m).__name__)
def test_what_is_sent_to_the_guard_arrives_as_it_was(message: ToGuard) -> None:
    received = decode_to_guard(encode_to_guard(message))
    assert received == message
    assert type(received) is type(message)


@pytest.mark.parametrize("message", FROM_GUARD, ids=lambda m: type(m).__name__)
def test_what_the_guard_sends_arrives_as_it_was(message: FromGuard) -> None:
    received = decode_from_guard(encode_from_guard(message))
    assert received == message
    assert type(received) is type(message)


stamps = st.integers(-(2**63), 2**63 - 1)
sticks = st.builds(Sticks, *[st.floats(width=64)] * 4)


def bits(values: Any) -> bytes:
    """NaN is not equal to itself, its bytes are."""
    return struct.pack(f"<{len(values)}d", *values)


@given(st.tuples(*[stamps] * 7), st.lists(sticks, max_size=40))
def test_any_chunk_arrives_bit_by_bit(seven: tuple[int, ...], actions: list[Sticks]) -> None:
    sent = Chunk(*seven, tuple(actions))  # type: ignore[call-arg,arg-type]
    received = decode_to_guard(encode_to_guard(sent))
    assert isinstance(received, Chunk)
    assert received[:7] == seven
    assert [bits(action) for action in received.actions] == [bits(action) for action in actions]


@pytest.mark.parametrize("data", [b"", b"\0", b"Q", b"S", b"Snonsense", b"C", b"R\0"])
def test_what_is_no_message_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="not a message"):
        decode_to_guard(data)
    with pytest.raises(ValueError, match="not a message"):
        decode_from_guard(data)


@pytest.mark.parametrize(
    ("decode", "whole"),
    [
        (decode_to_guard, encode_to_guard(CHUNK)),
        (decode_to_guard, encode_to_guard(FLIGHT)),
        (decode_from_guard, encode_from_guard(TICK)),
    ],
)
def test_a_message_that_is_cut_off_or_too_long_is_refused(
    decode: Callable[[bytes], object], whole: bytes
) -> None:
    for length in range(len(whole)):
        with pytest.raises(ValueError, match="not a message"):
            decode(whole[:length])
    with pytest.raises(ValueError, match="not a message"):
        decode_to_guard(encode_to_guard(CHUNK) + b"\0")


@pytest.mark.parametrize("number", [np.float64(1.5), np.float32(1.5), np.int64(7), np.bool_(True)])
def test_a_number_of_numpy_crosses_as_a_plain_one(number: Any) -> None:
    message = because(Code.TOO_OLD, age_ms=number)
    received = decode_to_guard(encode_to_guard(message))
    assert received == message
    assert type(dict(received.data)["age_ms"]) in (float, int, bool)


def test_reasons_cross_in_python_3_11_2(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one of Debian 12: its enumerations ask pickle for ``getattr``."""

    def by_name(code: Enum, protocol: int) -> tuple[object, ...]:
        return getattr, (type(code), code.name)

    monkeypatch.setattr(Enum, "__reduce_ex__", by_name)
    message = because(Code.OF_CAMERA, camera="front", why=because(Code.NO_IMAGE))
    assert decode_to_guard(encode_to_guard(message)) == message


@pytest.mark.parametrize("foreign", [np.zeros(2), os.system, partial(print), Popen])
def test_nothing_but_our_classes_crosses(foreign: Any) -> None:
    """Importing numpy would stall the guard."""
    message = Reason(Code.TOO_OLD, (("age_ms", foreign),))
    with pytest.raises(ValueError, match="not a message"):
        decode_to_guard(encode_to_guard(message))
