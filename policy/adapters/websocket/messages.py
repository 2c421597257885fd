"""Messages of openpi's websocket protocol: msgpack maps, with numpy arrays as maps of their own.

An array is ``{b"__ndarray__": True, b"data": bytes, b"dtype": "<f4", b"shape": [2, 3]}``, row by
row; a number of numpy's is ``{b"__npgeneric__": True, b"data": 1.5, b"dtype": "<f4"}``. Some
servers write these keys as text, which is read as well. Nothing is ever unpickled, and only numbers
are made of bytes.
"""

import math
import re
from collections.abc import Mapping
from typing import TypeAlias

import msgpack
import numpy as np
from numpy.typing import NDArray

from policy.errors import PolicyError

Message: TypeAlias = dict[str, object]
CONTRACT_KEY = "mavbridge_contract"
"""Key in the metadata of our own server: its contract as JSON."""
ARRAY, NUMBER = "__ndarray__", "__npgeneric__"
MAX_DIMENSIONS = 8
_NUMERIC_DTYPE = re.compile(r"[<>|=]?[biuf][1248]|bool|u?int(8|16|32|64)|float(16|32|64)")


class MessageError(PolicyError):
    """A message that is not of the protocol."""


def pack(message: Mapping[str, object]) -> bytes:
    """Write a message; its values are numbers, texts, lists, maps, and numpy arrays of numbers."""
    packed: bytes = msgpack.packb(message, default=_pack_numpy)
    return packed


def unpack(data: bytes | str) -> Message:
    """Read a message; arrays are read-only views of ``data``.

    Nothing in it can claim more memory than a small multiple of its own length.
    """
    if isinstance(data, str):
        raise MessageError(f"a text in place of a msgpack map: {last_line(data)}")
    try:
        message = msgpack.unpackb(data, object_hook=_unpack_numpy, strict_map_key=False)
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
        raise MessageError(f"not a msgpack map of openpi's protocol: {error}") from error
    if not isinstance(message, dict):
        raise MessageError(f"a msgpack {type(message).__name__} in place of a map")
    return {_text(key): value for key, value in message.items()}


def last_line(text: str) -> str:
    """What a traceback ends with, or the end of another text, in at most 300 characters."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1][:300] if lines else "(nothing)"


def _text(value: object) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _pack_numpy(value: object) -> object:
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return {
            ARRAY.encode(): True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    if isinstance(value, np.generic) and value.dtype.kind in "biuf":
        return {NUMBER.encode(): True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"a {type(value).__name__} cannot be sent to a policy server")


def _unpack_numpy(found: dict[object, object]) -> object:
    if not any(key in found for key in (ARRAY, ARRAY.encode(), NUMBER, NUMBER.encode())):
        return found
    entries = {_text(key): value for key, value in found.items()}
    data, dtype = entries.get("data"), _dtype(entries.get("dtype"))
    if NUMBER in entries:
        if not isinstance(data, bool | int | float):
            raise ValueError("a number of numpy's without its value")
        return dtype.type(data)
    shape = entries.get("shape")
    if (
        not isinstance(data, bytes)
        or not isinstance(shape, list)
        or len(shape) > MAX_DIMENSIONS
        or not all(isinstance(side, int) and side >= 0 for side in shape)
        or math.prod(shape) * dtype.itemsize != len(data)
    ):
        raise ValueError("an array whose bytes, dtype and shape do not belong together")
    return np.frombuffer(data, dtype).reshape(shape)


def _dtype(text: object) -> np.dtype[np.generic]:
    name = _text(text)
    if not _NUMERIC_DTYPE.fullmatch(name):
        raise ValueError(f"an array of dtype {name!r}: only booleans and numbers are taken")
    return np.dtype(name)


def number_array(message: Message, key: str) -> NDArray[np.generic]:
    """An array of numbers in a message, or a list of them."""
    if key not in message:
        raise MessageError(f"no {key!r} in it; it has {sorted(message)}")
    try:
        array = np.asarray(message[key])
    except ValueError as error:
        raise MessageError(f"{key!r} is no array: {error}") from error
    if array.dtype.kind not in "biuf":
        raise MessageError(f"{key!r} is no array of numbers but {type(message[key]).__name__}")
    return array
