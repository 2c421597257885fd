"""Bytes of openpi's protocol, written by hand from its definition and that of msgpack."""

import pickle
from contextlib import suppress

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from policy.adapters.websocket.messages import (
    MessageError,
    last_line,
    number_array,
    pack,
    unpack,
)

KEYS = (b"\xc4\x0b__ndarray__\xc3", b"\xc4\x04data", b"\xc4\x05dtype", b"\xc4\x05shape")
"""bin 8 keys; the first with its value, true."""
ONE_F32 = b"\x81\xa5state\x84" + KEYS[0] + KEYS[1] + b"\xc4\x04\x00\x00\x80\x3f"
ONE_F32 += KEYS[2] + b"\xa3<f4" + KEYS[3] + b"\x91\x01"
"""{"state": array([1.0], float32)}."""
IMAGE = b"\x82\xa5image\x84" + KEYS[0] + KEYS[1] + b"\xc4\x06\x01\x02\x03\x04\x05\x06"
IMAGE += KEYS[2] + b"\xa3|u1" + KEYS[3] + b"\x93\x01\x02\x03" + b"\xa6prompt\xa2go"


def test_a_request_has_the_bytes_of_the_protocol() -> None:
    assert pack({"state": np.array([1.0], np.float32)}) == ONE_F32
    image = np.arange(1, 7, dtype=np.uint8).reshape(1, 2, 3)
    assert pack({"image": image, "prompt": "go"}) == IMAGE
    flipped = image[:, ::-1][:, ::-1]  # strides of its own, the same pixels
    assert pack({"image": flipped, "prompt": "go"}) == IMAGE


def test_the_bytes_of_the_protocol_are_read() -> None:
    assert unpack(ONE_F32)["state"] == np.float32(1.0)
    message = unpack(IMAGE)
    image = number_array(message, "image")
    assert (image.dtype, image.shape, message["prompt"]) == (np.uint8, (1, 2, 3), "go")
    assert image.tolist() == [[[1, 2, 3], [4, 5, 6]]]
    with_scalar = pack({"x": np.float32(2.5)})
    assert with_scalar == b"\x81\xa1x\x83\xc4\x0d__npgeneric__\xc3\xc4\x04data\xcb" + (
        b"\x40\x04\x00\x00\x00\x00\x00\x00\xc4\x05dtype\xa3<f4"
    )
    assert unpack(with_scalar)["x"] == 2.5


@pytest.mark.parametrize("dtype", ["<f8", "<f4", "<f2", "<i8", "<i4", "|i1", "|u1", "|b1", ">f4"])
def test_every_kind_of_number_arrives_as_it_was(dtype: str) -> None:
    sent = np.array([[0, 1], [1, 0]], dtype)
    received = number_array(unpack(pack({"x": sent})), "x")
    assert received.dtype == sent.dtype
    assert np.array_equal(received, sent)


def test_variants_of_other_servers_are_read() -> None:
    data = np.array([1.5], np.float32).tobytes()
    text_keys = {"__ndarray__": True, "data": data, "dtype": "float32", "shape": [1]}
    bytes_dtype = {b"__ndarray__": True, b"data": data, b"dtype": b"<f4", b"shape": (1,)}
    for array in (text_keys, bytes_dtype, [1.5]):
        message = unpack(msgpack.packb({"actions": array}))
        assert number_array(message, "actions").tolist() == [1.5]
    assert unpack(msgpack.packb({1: "a", b"b": 2})) == {"1": "a", "b": 2}


def array(**changes: object) -> bytes:
    good = {"__ndarray__": True, "data": b"\0" * 8, "dtype": "<f4", "shape": [2]}
    return msgpack.packb({"actions": {**good, **changes}})


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"garbage, and not msgpack",
        pickle.dumps({"actions": [1, 2]}),
        msgpack.packb([1, 2]),
        msgpack.packb({"a": 1}) + b"\0",
        b"\xdd\xff\xff\xff\xff",  # an array of four thousand million entries, in five bytes
        b"\x91" * 100_000,
        array(dtype="|O"),
        array(dtype="O8"),
        array(dtype="<f4,<f4"),
        array(dtype="|V4"),
        array(dtype="<c8"),
        array(dtype=7),
        array(shape=[3]),
        array(shape=[-2]),
        array(shape=[2**62, 4]),
        array(shape="2"),
        array(shape=[1] * 100),
        array(data="text"),
        msgpack.packb({"x": {"__npgeneric__": True, "data": b"1", "dtype": "<f4"}}),
        msgpack.packb({"x": {"__ndarray__": True}}),
    ],
)
def test_what_is_malformed_is_refused(data: bytes) -> None:
    with pytest.raises(MessageError):
        unpack(data)


@given(st.binary(max_size=200))
def test_no_bytes_raise_anything_else(data: bytes) -> None:
    with suppress(MessageError):
        assert isinstance(unpack(data), dict)


def test_errors_name_what_is_there() -> None:
    with pytest.raises(MessageError, match=r"no 'actions' in it; it has \['action'\]"):
        number_array({"action": 1}, "actions")
    with pytest.raises(MessageError, match="'actions' is no array of numbers but str"):
        number_array({"actions": "left"}, "actions")
    with pytest.raises(MessageError, match="'actions' is no array"):
        number_array({"actions": [[1, 2], [3]]}, "actions")
    with pytest.raises(MessageError, match="KeyError: 'image'"):
        unpack("Traceback (most recent call last):\n  File x\nKeyError: 'image'\n")
    assert last_line("") == "(nothing)"
    with pytest.raises(TypeError, match="object"):
        pack({"x": object()})
