"""Every message between the processes arrives as it was sent."""

import io
import os
import struct
from collections.abc import Callable
from enum import Enum, StrEnum
from functools import partial
from pathlib import Path
from subprocess import Popen
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.factories import make_guard_tick
from helpers.guard_facts import flight_settings
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.ticks import GuardTick
from mavbridge.core.vehicle import ACTION_CLASSES, NEUTRAL, Reading, Sample, Telemetry
from mavbridge.guard.chunks import Chunk
from mavbridge.guard.values import GuardSettings, Phase
from mavbridge.guard.wire import (
    FromGuard,
    LastWords,
    Samples,
    ToGuard,
    decode_from_guard,
    decode_to_guard,
    encode,
    read_settings,
)

CHUNK = Chunk(1, 2, 3, 4, 5, 6, 7, (NEUTRAL, NEUTRAL))
stamps = st.integers(-(2**63), 2**63 - 1)
numbers = st.floats(allow_nan=False)  # NaN is not equal to itself
four = st.tuples(*[numbers] * 4)
chunks = st.sampled_from(list(ACTION_CLASSES.values())).flatmap(
    lambda kind: st.builds(
        Chunk,
        **dict.fromkeys(Chunk._fields, stamps)
        | {"actions": st.lists(four.map(kind._make), max_size=40).map(tuple)},
    )
)
readings = st.sampled_from(list(zip(Telemetry._fields, (4, 3, 3, 3, 3, 1), strict=True))).flatmap(
    lambda quantity: st.builds(
        Sample,
        st.just(quantity[0]),
        st.builds(Reading, stamps, st.tuples(*[numbers] * quantity[1]), stamps),
    )
)
reasons = st.recursive(
    st.builds(because, st.sampled_from(Code), said=st.text(), ms=st.integers() | numbers),
    lambda inner: st.builds(because, st.sampled_from(Code), why=inner),
    max_leaves=3,
)
st.register_type_strategy(Reason, reasons)
st.register_type_strategy(float, numbers)
st.register_type_strategy(Path, st.just(Path("key")))
receivers = st.sampled_from((None, ("127.0.0.1", 14550), ("::1", 14550, 0, 0)))
SAID = get_args(FromGuard)
ERRORS = [kind for kind in SAID if issubclass(kind, Exception)]
OF_ANY_KIND = {
    Chunk: chunks,
    Samples: st.builds(Samples, st.lists(readings).map(tuple)),
    LastWords: st.builds(LastWords, receiver=receivers),
    GuardTick: st.builds(GuardTick, phase=st.sampled_from(Phase)),
}


@pytest.mark.parametrize(
    ("kind", "decode"),
    [
        (GuardSettings, lambda data: read_settings(io.BytesIO(data))),
        *((kind, decode_to_guard) for kind in get_args(ToGuard)),
        *((kind, decode_from_guard) for kind in SAID if kind not in ERRORS),
    ],
)
@settings(max_examples=30)
@given(data=st.data())
def test_any_message_arrives_as_it_was(
    kind: Any, decode: Callable[[bytes], object], data: Any
) -> None:
    message = data.draw(OF_ANY_KIND.get(kind, st.from_type(kind)))
    received = decode(encode(message))
    assert type(received) is type(message)
    assert received == message


@pytest.mark.parametrize("kind", ERRORS)
def test_an_error_arrives_with_its_text_and_exit_status(kind: type[MavbridgeError]) -> None:
    error: Any = decode_from_guard(encode(kind("no vehicle\n")))
    assert (type(error), str(error)) == (kind, "no vehicle\n")
    assert error.exit_code is kind.exit_code


def test_numbers_of_a_chunk_arrive_bit_by_bit() -> None:
    odd = NEUTRAL._make((1e-300, -0.0, float("inf"), float("nan")))
    received = decode_to_guard(encode(CHUNK._replace(actions=(odd,))))
    assert isinstance(received, Chunk)
    assert struct.pack("<4d", *received.actions[0]) == struct.pack("<4d", *odd)


@pytest.mark.parametrize("data", [b"", b"\0", b"nonsense", b"N.", b"C", b"R\0"])
def test_what_is_no_message_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="not a message"):
        decode_to_guard(data)
    with pytest.raises(ValueError, match="not a message"):
        decode_from_guard(data)


@pytest.mark.parametrize(
    ("decode", "whole"),
    [
        (decode_to_guard, encode(CHUNK)),
        (decode_to_guard, encode(flight_settings())),
        (decode_from_guard, encode(make_guard_tick(1))),
    ],
)
def test_a_message_that_is_cut_off_is_refused(
    decode: Callable[[bytes], object], whole: bytes
) -> None:
    for length in range(len(whole)):
        with pytest.raises(ValueError, match="not a message"):
            decode(whole[:length])


@pytest.mark.parametrize("number", [np.float64(1.5), np.float32(1.5), np.int64(7), np.bool_(True)])
def test_a_number_of_numpy_crosses_as_a_plain_one(number: Any) -> None:
    message = because(Code.TOO_OLD, age_ms=number)
    received = decode_to_guard(encode(message))
    assert received == message
    assert type(dict(received.data)["age_ms"]) in (float, int, bool)


class Camera(StrEnum):
    FRONT = "front"


class Name(str):
    """A user's own type of text."""


@pytest.mark.parametrize("text", [Camera.FRONT, Name("front"), np.str_("front")])
def test_a_text_of_a_users_own_type_crosses_as_a_plain_one(text: str) -> None:
    received = decode_to_guard(encode(because(Code.OF_CAMERA, camera=text)))
    assert type(dict(received.data)["camera"]) is str
    assert received == because(Code.OF_CAMERA, camera="front")


def test_reasons_cross_in_python_3_11_2(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one of Debian 12: its enumerations ask pickle for ``getattr``."""

    def by_name(code: Enum, protocol: int) -> tuple[object, ...]:
        return getattr, (type(code), code.name)

    monkeypatch.setattr(Enum, "__reduce_ex__", by_name)
    message = because(Code.OF_CAMERA, camera="front", why=because(Code.NO_IMAGE))
    assert decode_to_guard(encode(message)) == message


@pytest.mark.parametrize("foreign", [np.zeros(2), os.system, partial(print), Popen])
def test_nothing_but_our_classes_crosses(foreign: Any) -> None:
    """Importing numpy would stall the guard."""
    message = Reason(Code.TOO_OLD, (("age_ms", foreign),))
    with pytest.raises(ValueError, match="not a message"):
        decode_to_guard(encode(message))
