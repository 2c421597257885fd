from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from policy.adapters.interface import Interface
from policy.adapters.websocket.messages import MessageError, pack, unpack
from policy.adapters.websocket.observation import (
    HISTORY_KEY,
    from_message,
    from_uint8,
    to_message,
    to_uint8,
)
from policy.contract import Contract
from policy.preprocess import fit_image, image_to_input

NORMALISATIONS: list[dict[str, Any]] = [
    {},
    {"image_mean_rgb": (0.0, 0.0, 0.0), "image_std_rgb": (1.0, 1.0, 1.0)},
    {"image_mean_rgb": (0.5, 0.5, 0.5), "image_std_rgb": (0.5, 0.5, 0.5)},
    {"image_mean_rgb": (0.9, 0.1, 0.5), "image_std_rgb": (0.01, 0.3, 7.0)},
]


@pytest.mark.parametrize("normalisation", NORMALISATIONS)
@pytest.mark.parametrize("channels", ["rgb", "bgr"])
def test_every_level_of_a_picture_comes_back(normalisation: dict[str, Any], channels: Any) -> None:
    contract = Contract(image_height=16, image_width=16, image_channels=channels, **normalisation)
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    rgb = np.stack([levels, levels[::-1], levels.T], axis=-1)
    planes = image_to_input(rgb, contract)
    sent = to_uint8(planes, contract)[0]
    assert np.array_equal(sent, rgb if channels == "rgb" else rgb[..., ::-1])
    assert np.array_equal(from_uint8(sent, contract)[None], planes)


def test_a_camera_picture_is_cut_once() -> None:
    contract = Contract(
        image_height=32, image_width=48, image_crop=(0.25, 0.1, 1.0, 0.9), image_fit="pad"
    )
    camera = np.random.default_rng(0).integers(0, 256, (90, 160, 3), dtype=np.uint8)
    planes = image_to_input(camera, contract)
    sent = to_uint8(planes, contract)[0]
    assert np.array_equal(sent, fit_image(camera, contract))
    assert np.array_equal(from_uint8(sent, contract)[None], planes)


def contract_of(steps: int, cameras: tuple[str, ...]) -> Contract:
    return Contract(image_height=16, image_width=24, observation_steps=steps, cameras=cameras)


@pytest.mark.parametrize("steps", [1, 2])
@pytest.mark.parametrize("cameras", [("front",), ("front", "down")])
def test_an_observation_arrives_as_it_was_sent(steps: int, cameras: tuple[str, ...]) -> None:
    contract = contract_of(steps, cameras)
    interface, rng = Interface(contract=contract), np.random.default_rng(0)
    stack = contract.image_shape[:-3]
    pictures = rng.integers(0, 256, (*stack, 16, 24, 3), dtype=np.uint8)
    image = from_uint8(pictures, contract)
    state = rng.normal(size=contract.state_shape).astype(np.float32)
    history = rng.normal(size=(4, 4)).astype(np.float32)
    message = unpack(pack(to_message(interface, image, state, history=history)))
    assert set(message) == {
        *(f"observation.images.{name}" for name in cameras),
        "observation.state",
        "action_history",
    }
    if len(cameras) == 2:
        assert np.array_equal(message["observation.images.down"], pictures[..., 1, :, :, :])
    received = from_message(interface, message)
    for got, sent in zip(received, (image, state, history), strict=True):
        assert np.array_equal(got, sent[None])


@pytest.mark.parametrize("steps", [1, 2])
@pytest.mark.parametrize("cameras", [("front",), ("front", "down")])
def test_depth_is_sent_in_metres(steps: int, cameras: tuple[str, ...]) -> None:
    contract = replace(contract_of(steps, cameras), image_channels="depth")
    interface, rng = Interface(contract=contract), np.random.default_rng(0)
    image = rng.uniform(0, 65, contract.image_shape).astype(np.float32)
    state = rng.normal(size=contract.state_shape).astype(np.float32)
    history = rng.normal(size=(4, 4)).astype(np.float32)
    message = unpack(pack(to_message(interface, image, state, history=history)))
    sent: Any = message[f"observation.images.{cameras[-1]}"]
    assert sent.dtype == np.float32
    assert np.array_equal(
        sent, (image if len(cameras) == 1 else image[..., 1, :, :, :])[..., 0, :, :]
    )
    received = from_message(interface, message)
    for got, given in zip(received, (image, state, history), strict=True):
        assert np.array_equal(got, given[None])


def test_keys_and_names_are_those_of_the_contract_file() -> None:
    interface = Interface(
        contract=contract_of(1, ("front",)),
        state_names=("wz_radps", "vx_mps"),
        state_key="observation/state",
        image_keys=("observation/image",),
        prompt="fly through the gates",
    )
    state = np.arange(13, dtype=np.float32)
    message = to_message(interface, np.zeros((3, 16, 24), np.float32), state, history=None)
    assert set(message) == {"observation/image", "observation/state", "prompt"}
    sent: Any = message["observation/state"]
    assert (sent.tolist(), sent.dtype) == ([9.0, 0.0], np.float32)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"observation.state": None}, "no 'observation.state'"),
        ({"observation.state": np.zeros(12, np.float32)}, r"float32 \[13\], got float32 \[12\]"),
        ({"observation.state": np.full(13, np.nan, np.float32)}, "NaN"),
        ({HISTORY_KEY: np.zeros((4, 3), np.float32)}, r"\[4, 4\]"),
        ({"observation.images.front": np.zeros((16, 24, 3), np.float32)}, "uint8"),
        ({"observation.images.front": np.zeros((3, 16, 24), np.uint8)}, r"\[16, 24, 3\]"),
    ],
)
def test_a_request_that_does_not_fit_is_refused(changes: dict[str, Any], told: str) -> None:
    interface = Interface(contract=contract_of(1, ("front",)))
    image = np.zeros((3, 16, 24), np.float32)
    state, history = np.zeros(13, np.float32), np.zeros((4, 4), np.float32)
    message = {**to_message(interface, image, state, history=history), **changes}
    message = {key: value for key, value in message.items() if value is not None}
    with pytest.raises(MessageError, match=told):
        from_message(interface, message)
