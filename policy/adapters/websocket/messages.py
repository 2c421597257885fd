"""Messages of openpi's websocket protocol: msgpack maps, with numpy arrays encoded as maps.

An array is ``{b"__ndarray__": True, b"data": bytes, b"dtype": "<f4", b"shape": [2, 3]}``, in
row-major order; a numpy scalar is ``{b"__npgeneric__": True, b"data": 1.5, b"dtype": "<f4"}``. Some
servers write these keys as text, which is accepted too. Nothing is ever unpickled, and bytes are
only decoded to numbers.

An observation has one key for each camera: uint8 [H, W, 3], or [T, H, W, 3] with several
observations, cropped and resized by the contract and in its channel order; depth is float32 in
metres, [H, W] or [T, H, W]. The state is float32 [S] or [T, S]. The keys are those of
``adapters.interface``.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import TypeAlias

import msgpack
import numpy as np
from numpy.typing import NDArray

from policy.adapters.interface import Interface
from policy.contract import Contract, FloatArray
from policy.errors import PolicyError
from policy.files import last_line
from policy.preprocess import image_to_input, input_to_bytes

Message: TypeAlias = dict[str, object]
CONTRACT_KEY = "mavbridge_contract"
"""Key in the metadata of mavbridge's own server: its contract as JSON."""
FIELDS_KEY = "mavbridge_fields"
"""Key in the metadata of another server: the contract fields that it knows, as JSON."""
ARRAY, NUMBER = "__ndarray__", "__npgeneric__"
MAX_DIMENSIONS = 8
_NUMERIC_DTYPE = re.compile(r"[<>|=]?[biuf][1248]|bool|u?int(8|16|32|64)|float(16|32|64)")
HISTORY_KEY = "action_history"
"""Key in requests to mavbridge's own server: action history, float32 [K + P, 4]."""
PREFIX_KEY, DELAY_KEY = "prefix", "delay_s"
"""Keys in requests under a contract with ``prefix_len`` P: the committed actions, float32 [P, 4] in
the server's units and order, NaN where none is committed; and the time of the last answer [s]."""
RESET_KEY = "reset"
"""Key in requests to mavbridge's own server: true if a flight has begun since the last request."""


class MessageError(PolicyError):
    """Message that does not follow the protocol."""


def pack(message: Mapping[str, object]) -> bytes:
    """Encode a message of numbers, texts, lists, maps and numeric numpy arrays."""
    packed: bytes = msgpack.packb(message, default=_pack_numpy)
    return packed


def unpack(data: bytes | str) -> Message:
    """Decode a message; arrays are read-only views of ``data``.

    Decoding uses at most a small multiple of the message's length in memory, for any sizes that it
    claims.
    """
    if isinstance(data, str):
        raise MessageError(f"a text in place of a msgpack map: {last_line(data)}")
    try:
        message = msgpack.unpackb(data, object_hook=_unpack_numpy, strict_map_key=False)
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
        why = str(error) or type(error).__name__
        raise MessageError(f"not a msgpack map of openpi's protocol: {why}") from error
    if not isinstance(message, dict):
        raise MessageError(f"a msgpack {type(message).__name__} in place of a map")
    return {_text(key): value for key, value in message.items()}


def _text(value: object) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _pack_numpy(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf":
        kind = {b"dtype": value.dtype.str}
        if isinstance(value, np.generic):
            return {NUMBER.encode(): True, b"data": value.item(), **kind}
        return {ARRAY.encode(): True, b"data": value.tobytes(), **kind, b"shape": value.shape}
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
    """Return an array, or a list of numbers, of a message as an array."""
    if key not in message:
        raise MessageError(f"no {key!r} in it; it has {sorted(message)}")
    value = message[key]
    if isinstance(value, np.ndarray | np.generic):
        return np.asarray(value)
    try:
        # Without a dtype, each text of a list would take the room of the longest: terabytes.
        array = np.asarray(value, np.float64)
        for each in np.asarray(value, object).flat:  # texts, None and booleans are converted
            if isinstance(each, bool) or not isinstance(each, int | float | np.number):
                raise TypeError(f"it holds {each!r:.60}")
        return array
    except (TypeError, ValueError) as error:
        told = f"{type(value).__name__}: {last_line(error)}"
        raise MessageError(f"{key!r} is no array of numbers but {told}") from error


def to_message(
    interface: Interface,
    image: FloatArray,
    state: FloatArray,
    history: FloatArray,
    *,
    is_ours: bool,
    delay_s: float,
) -> Message:
    """Return one observation's request, without the batch; ``is_ours``: with the history."""
    contract = interface.contract
    images = image[..., 0, :, :] if contract.is_depth else to_uint8(image, contract)
    # [N, H, W, 3] and [T, N, H, W, 3] only with several cameras
    cameras = -1 - len(contract.picture_shape)
    per_camera = [images] if len(contract.cameras) == 1 else list(np.moveaxis(images, cameras, 0))
    message: Message = dict(zip(interface.camera_keys, per_camera, strict=True))
    message[interface.state_key] = interface.to_state(state)
    if interface.prompt:
        message["prompt"] = interface.prompt
    if is_ours:
        message[HISTORY_KEY] = history
    elif contract.prefix_len:
        message[PREFIX_KEY] = interface.from_actions(history[contract.history_len :])
        message[DELAY_KEY] = delay_s
    return message


def from_message(
    interface: Interface, message: Message
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return image, state and history of a request, batched, as arguments of ``predict``."""
    contract = interface.contract
    stack = () if contract.observation_steps == 1 else (contract.observation_steps,)
    shape, kind = (*stack, *contract.picture_shape), "f" if contract.is_depth else "u"
    images = [_array(message, key, shape, kind) for key in interface.camera_keys]
    cameras = -1 - len(contract.picture_shape)
    stacked = images[0] if len(images) == 1 else np.stack(images, axis=cameras)
    state = _array(message, interface.state_key, contract.state_shape, "f").astype(np.float32)
    history = _array(message, HISTORY_KEY, contract.history_shape, "f", contract.history_len)
    if contract.is_depth:
        planes: FloatArray = stacked.astype(np.float32)[..., None, :, :]
    else:
        planes = from_uint8(stacked.astype(np.uint8), contract)
    return planes[None], state[None], history.astype(np.float32)[None]


def _array(
    message: Message, key: str, shape: tuple[int, ...], kind: str, finite: int | None = None
) -> NDArray[np.generic]:
    """Return an array of the request, finite as float32; NaN may follow ``finite`` rows."""
    array = number_array(message, key)
    is_kind = array.dtype == np.uint8 if kind == "u" else array.dtype.kind == kind
    if not is_kind or array.shape != shape:
        wanted = "uint8" if kind == "u" else "float32"
        raise MessageError(
            f"{key!r} must be {wanted} {list(shape)}, got {array.dtype} {list(array.shape)}"
        )
    if kind == "f":
        with np.errstate(over="ignore"):
            numbers = array.astype(np.float32)
        if np.isinf(numbers).any() or np.isnan(numbers[:finite]).any():
            raise MessageError(f"{key!r} holds NaN, or a number beyond float32")
    return array


def to_uint8(planes: FloatArray, contract: Contract) -> NDArray[np.uint8]:
    """Convert normalised images [..., 3, H, W] back to uint8 [..., H, W, 3], exactly."""
    levels = input_to_bytes(planes, contract).astype(np.uint8)
    return np.ascontiguousarray(np.moveaxis(levels, -3, -1))


def from_uint8(images: NDArray[np.uint8], contract: Contract) -> FloatArray:
    """Normalise images that are already cropped and resized -> [..., 3, H, W]."""
    whole = replace(contract, image_crop=(0.0, 0.0, 1.0, 1.0))
    rgb = images if contract.image_channels == "rgb" else images[..., ::-1]
    each = rgb.reshape(-1, *rgb.shape[-3:])
    planes = np.concatenate([image_to_input(np.ascontiguousarray(one), whole) for one in each])
    return planes.reshape(*rgb.shape[:-3], *planes.shape[1:])
