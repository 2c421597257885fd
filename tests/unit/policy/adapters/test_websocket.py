"""openpi's protocol: addresses, bytes written by hand from its definition, and observations."""

import importlib.util
import pickle
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavbridge.commands.config import ServeConfig
from mavbridge.config.policy import PolicyConfig
from policy.adapters.interface import Interface
from policy.adapters.websocket.kind import check_server
from policy.adapters.websocket.messages import (
    MessageError,
    from_message,
    from_uint8,
    number_array,
    pack,
    to_message,
    to_uint8,
    unpack,
)
from policy.adapters.websocket.remote_policy import ServerLink
from policy.contract import Contract
from policy.errors import MavbridgeError, PolicyError
from policy.loading.load import check_request
from policy.loading.request import PolicyRequest
from policy.preprocess import image_to_input


@pytest.mark.parametrize(
    ("url", "told"),
    [
        *((url, None) for url in ("ws://[::1]:8000", "wss://policies.example", "ws://gpu:80/path")),
        ("ws://127.0.0.1", "write ws://HOST:PORT"),
        ("ws:127.0.0.1:8000", "write ws://HOST:PORT"),
        ("ws://gpu:99999", "write ws://HOST:PORT"),
        ("ws://me:secret@gpu:8000", "leave the name and password out"),
    ],
)
def test_addresses_of_servers(url: str, told: str | None) -> None:
    if told is None:
        check_request(PolicyRequest(spec=url))
        return
    with pytest.raises(PolicyError, match=told) as refusal:
        check_request(PolicyRequest(spec=url))
    assert "secret" not in str(refusal.value)


def test_flags_and_packages_that_a_server_needs(tmp_path, monkeypatch):
    url = "ws://127.0.0.1:8000"
    with pytest.raises(PolicyError, match="the server has the weights"):
        check_server(url, None, Path("my.safetensors"))
    with pytest.raises(PolicyError, match=r"--contract .*none\.toml"):
        check_server(url, tmp_path / "none.toml", None)
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "msgpack" else object()
    )
    with pytest.raises(MavbridgeError, match=r"needs msgpack: pip install msgpack"):
        check_server(url, None, None)


def test_settings_of_our_server() -> None:
    for host in ("[::1]", "fe80::1%eth0", "localhost"):
        assert ServeConfig(host=host).host == host.strip("[]")
    with pytest.raises(MavbridgeError, match="port"):
        ServeConfig(port=0)
    with pytest.raises(MavbridgeError, match="leave out --dual-rate"):
        ServeConfig(policy=PolicyConfig(dual_rate=True))


KEYS = (b"\xc4\x0b__ndarray__\xc3", b"\xc4\x04data", b"\xc4\x05dtype", b"\xc4\x05shape")
"""bin 8 keys; the first with its value, true."""
ONE_F32 = b"\x81\xa5state\x84" + KEYS[0] + KEYS[1] + b"\xc4\x04\x00\x00\x80\x3f"
ONE_F32 += KEYS[2] + b"\xa3<f4" + KEYS[3] + b"\x91\x01"
"""{"state": array([1.0], float32)}."""


def test_messages_have_the_bytes_of_the_protocol() -> None:
    assert pack({"state": np.array([1.0], np.float32)}) == ONE_F32
    assert unpack(ONE_F32)["state"] == np.float32(1.0)
    with_scalar = pack({"x": np.float32(2.5)})
    assert with_scalar == b"\x81\xa1x\x83\xc4\x0d__npgeneric__\xc3\xc4\x04data\xcb" + (
        b"\x40\x04\x00\x00\x00\x00\x00\x00\xc4\x05dtype\xa3<f4"
    )
    assert unpack(with_scalar)["x"] == 2.5


@pytest.mark.parametrize("dtype", ["<f8", "<f2", "<i8", "|u1", "|b1", ">f4"])
def test_every_kind_of_number_arrives_as_it_was(dtype: str) -> None:
    sent = np.array([[0, 1], [1, 0]], dtype)[:, ::-1]
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
        b"\xc1 is no type",
        pickle.dumps({"actions": [1, 2]}),
        msgpack.packb([1, 2]),
        b"\xdd\xff\xff\xff\xff",  # an array of four thousand million entries, in five bytes
        b"\x91" * 100_000,
        array(dtype="|O"),
        array(dtype="<f4,<f4"),
        array(shape=[3]),
        array(shape=[2**62, 4]),
        array(shape=[1] * 100),
        array(data="text"),
        msgpack.packb({"x": {"__npgeneric__": True, "data": b"1", "dtype": "<f4"}}),
    ],
)
def test_malformed_messages_are_refused(data: bytes) -> None:
    with pytest.raises(MessageError, match=r"[^ :]$"):  # it says why
        unpack(data)


@given(st.binary(max_size=200))
def test_random_bytes_raise_nothing_but_a_message_error(data: bytes) -> None:
    with suppress(MessageError):
        assert isinstance(unpack(data), dict)


def test_errors_name_what_is_there() -> None:
    with pytest.raises(MessageError, match=r"no 'actions' in it; it has \['action'\]"):
        number_array({"action": 1}, "actions")
    with pytest.raises(MessageError, match="'actions' is no array of numbers but str"):
        number_array({"actions": "left"}, "actions")
    with pytest.raises(MessageError, match="'actions' is no array"):
        number_array({"actions": [[1, 2], [3]]}, "actions")
    for each in ("0.5", b"0.5", None, True):  # which numpy would convert
        with pytest.raises(MessageError, match="'actions' is no array of numbers but list"):
            number_array({"actions": [[0.5, each]]}, "actions")
    assert number_array({"actions": [[1, 2.5]]}, "actions").tolist() == [[1.0, 2.5]]
    with pytest.raises(MessageError, match="'actions' is no array"):  # as texts of numpy: 2 TB
        number_array({"actions": ["a" * 700_000, *["b"] * 700_000]}, "actions")
    with pytest.raises(MessageError, match="KeyError: 'image'"):
        unpack("Traceback (most recent call last):\n  File x\nKeyError: 'image'\n")
    with pytest.raises(MessageError, match=r"\(nothing\)"):
        unpack("")
    with pytest.raises(TypeError, match="object"):
        pack({"x": object()})


@pytest.mark.parametrize("channels", ["rgb", "bgr"])
def test_every_level_of_a_picture_comes_back(channels: Any) -> None:
    scaling: Any = {"image_mean_rgb": (0.9, 0.1, 0.5), "image_std_rgb": (0.01, 0.3, 7.0)}
    contract = Contract(image_height=16, image_width=16, image_channels=channels, **scaling)
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    rgb = np.stack([levels, levels[::-1], levels.T], axis=-1)
    planes = image_to_input(rgb, contract)
    sent = to_uint8(planes, contract)[0]
    assert np.array_equal(sent, rgb if channels == "rgb" else rgb[..., ::-1])
    assert np.array_equal(from_uint8(sent, contract)[None], planes)


def contract_of(steps: int, cameras: tuple[str, ...]) -> Contract:
    return Contract(image_height=16, image_width=24, observation_steps=steps, cameras=cameras)


@pytest.mark.parametrize("channels", ["rgb", "depth"])
@pytest.mark.parametrize("steps", [1, 2])
@pytest.mark.parametrize("cameras", [("front",), ("front", "down")])
def test_an_observation_arrives_as_it_was_sent(steps, cameras, channels):
    contract = replace(contract_of(steps, cameras), image_channels=channels, prefix_len=steps)
    interface, rng = Interface(contract=contract), np.random.default_rng(0)
    stack = contract.image_shape[:-3]
    if contract.is_depth:  # float32 metres, without an axis of channels
        image = rng.uniform(0, 65, contract.image_shape).astype(np.float32)
        pictures = image[..., 0, :, :]
    else:
        pictures = rng.integers(0, 256, (*stack, 16, 24, 3), dtype=np.uint8)
        image = from_uint8(pictures, contract)
    state = rng.normal(size=contract.state_shape).astype(np.float32)
    history = rng.normal(size=contract.history_shape).astype(np.float32)
    history[contract.history_len + 1 :] = np.nan  # not committed
    message = unpack(pack(to_message(interface, image, state, history, is_ours=True, delay_s=0.1)))
    names = [f"observation.images.{name}" for name in cameras]
    assert set(message) == {*names, "observation.state", "action_history"}
    camera = -1 - len(contract.picture_shape)
    wanted = pictures if len(cameras) == 1 else np.take(pictures, -1, axis=camera)
    sent: Any = message[names[-1]]
    assert sent.dtype == pictures.dtype
    assert np.array_equal(sent, wanted)
    for got, given_ in zip(from_message(interface, message), (image, state, history), strict=True):
        assert np.array_equal(got, given_[None], equal_nan=True)


def test_keys_and_names_are_those_of_the_contract_file() -> None:
    interface = Interface(
        contract=replace(contract_of(1, ("front",)), prefix_len=2),
        state_names=("wz_radps", "vx_mps"),
        action_scale=(2.0, 1.0, 1.0, 1.0),
        state_key="observation/state",
        image_keys=("observation/image",),
        prompt="fly through the gates",
    )
    state = np.arange(13, dtype=np.float32)
    image, history = np.zeros((3, 16, 24), np.float32), np.full((6, 4), 0.5, np.float32)
    message = to_message(interface, image, state, history, is_ours=False, delay_s=0.1)
    own = {"observation/image", "observation/state", "prompt"}
    assert set(message) == {*own, "prefix", "delay_s"}
    prefix: Any = message["prefix"]
    assert (prefix.tolist(), message["delay_s"]) == ([[0.25, 0.5, 0.5, 0.5]] * 2, 0.1)
    sent: Any = message["observation/state"]
    assert (sent.tolist(), sent.dtype) == ([9.0, 0.0], np.float32)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"observation.state": None}, "no 'observation.state'"),
        ({"observation.state": np.zeros(12, np.float32)}, r"float32 \[13\], got float32 \[12\]"),
        ({"observation.state": np.full(13, np.nan, np.float32)}, "NaN"),
        ({"action_history": np.full((4, 4), np.nan, np.float32)}, "NaN"),
        ({"observation.state": np.full(13, 1e300)}, "float32"),
        ({"observation.images.front": np.zeros((16, 24, 3), np.float32)}, "uint8"),
        ({"observation.images.front": np.zeros((16, 24, 3), np.uint16)}, "uint8"),
        ({"observation.images.front": np.zeros((3, 16, 24), np.uint8)}, r"\[16, 24, 3\]"),
    ],
)
def test_a_request_that_does_not_fit_is_refused(changes: dict[str, Any], told: str) -> None:
    interface = Interface(contract=contract_of(1, ("front",)))
    image = np.zeros((3, 16, 24), np.float32)
    state, history = np.zeros(13, np.float32), np.zeros((4, 4), np.float32)
    asked = to_message(interface, image, state, history, is_ours=True, delay_s=0.1)
    message = {**asked, **changes}
    message = {key: value for key, value in message.items() if value is not None}
    with pytest.raises(MessageError, match=told):
        from_message(interface, message)


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("wss://host:1", r"by TLS \(ConnectionResetError\): write ws://"),
        ("ws://host:1", "cannot be reached: ConnectionResetError"),
    ],
)
def test_an_error_without_words_is_told_by_its_kind(url: str, told: str) -> None:
    assert re.search(told, ServerLink(url, api_key=None)._reason(ConnectionResetError()))
