"""An observation as ``predict`` takes it, to and from the message of a request.

Each camera's image has a key of its own and is uint8, [H, W, 3] or [T, H, W, 3] with several
observations, cut and sized by the contract and in its order of channels; depth is float32 in
metres, [H, W] or [T, H, W]. The state is float32 [S]
or [T, S]. The keys are those of ``adapters.interface``.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from policy.adapters.interface import Interface
from policy.adapters.websocket.messages import Message, MessageError, number_array
from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.preprocess import image_to_input, input_to_bytes

HISTORY_KEY = "action_history"
"""Key in requests to our own server: float32 [K, 4]."""
RESET_KEY = "reset"
"""Likewise: true where a flight has begun since the last request."""


def to_message(
    interface: Interface, image: FloatArray, state: FloatArray, *, history: FloatArray | None
) -> Message:
    """The request for one observation: arrays of ``predict``, without the batch.

    ``history`` [K, 4] is for our own server.
    """
    contract = interface.contract
    images = image[..., 0, :, :] if contract.is_depth else to_uint8(image, contract)
    # [N, H, W, 3] and [T, N, H, W, 3] only with several cameras
    cameras = -1 - len(contract.picture_shape)
    per_camera = [images] if len(contract.cameras) == 1 else list(np.moveaxis(images, cameras, 0))
    message: Message = dict(zip(interface.camera_keys, per_camera, strict=True))
    message[interface.state_key] = interface.to_state(state)
    if interface.prompt:
        message["prompt"] = interface.prompt
    if history is not None:
        message[HISTORY_KEY] = history
    return message


def from_message(
    interface: Interface, message: Message
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Image, state and history of a request, with the batch, as ``predict`` takes them."""
    contract = interface.contract
    stack = () if contract.observation_steps == 1 else (contract.observation_steps,)
    shape, kind = (*stack, *contract.picture_shape), "f" if contract.is_depth else "u"
    images = [_array(message, key, shape, kind) for key in interface.camera_keys]
    cameras = -1 - len(contract.picture_shape)
    stacked = images[0] if len(images) == 1 else np.stack(images, axis=cameras)
    state = _array(message, interface.state_key, contract.state_shape, "f").astype(np.float32)
    history_shape = (contract.history_len, ACTION_DIM)
    history = _array(message, HISTORY_KEY, history_shape, "f").astype(np.float32)
    if contract.is_depth:
        planes: FloatArray = stacked.astype(np.float32)[..., None, :, :]
    else:
        planes = from_uint8(stacked.astype(np.uint8), contract)
    return planes[None], state[None], history[None]


def _array(message: Message, key: str, shape: tuple[int, ...], kind: str) -> NDArray[np.generic]:
    array = number_array(message, key)
    if array.dtype.kind != kind or array.shape != shape:
        wanted = "uint8" if kind == "u" else "float32"
        raise MessageError(
            f"{key!r} must be {wanted} {list(shape)}, got {array.dtype} {list(array.shape)}"
        )
    if kind == "f" and not np.isfinite(array).all():
        raise MessageError(f"{key!r} holds NaN or infinity")
    return array


def to_uint8(planes: FloatArray, contract: Contract) -> NDArray[np.uint8]:
    """Normalised images [..., 3, H, W] -> what they were made of, uint8 [..., H, W, 3], exactly.

    float32 keeps the levels of a byte far apart: they come back with an error below 0.001.
    """
    levels = input_to_bytes(planes, contract).astype(np.uint8)
    return np.ascontiguousarray(np.moveaxis(levels, -3, -1))


def from_uint8(images: NDArray[np.uint8], contract: Contract) -> FloatArray:
    """The way back: images that are cut and sized already -> normalised [..., 3, H, W]."""
    whole = replace(contract, image_crop=(0.0, 0.0, 1.0, 1.0))
    rgb = images if contract.image_channels == "rgb" else images[..., ::-1]
    each = rgb.reshape(-1, *rgb.shape[-3:])
    planes = np.concatenate([image_to_input(np.ascontiguousarray(one), whole) for one in each])
    return planes.reshape(*rgb.shape[:-3], *planes.shape[1:])
