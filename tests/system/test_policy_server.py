"""Policies on servers: real sockets on loopback, every wait with a deadline."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from queue import Queue
from typing import Any

import numpy as np
import pytest
import websockets.sync.client
from websockets.exceptions import ConnectionClosed, InvalidStatus

from helpers.policy_servers import Guard, Reply, chunk_of, our_server, scripted_server
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.processes import free_port
from policy.adapters.websocket import remote_policy
from policy.adapters.websocket.kind import load_server_policy
from policy.adapters.websocket.messages import Message, number_array, pack, unpack
from policy.adapters.websocket.remote_policy import RemotePolicy, answer_deadline_s
from policy.contract import Contract, FloatArray
from policy.engines.runner import (
    ExecutionSettings,
    encode_all,
    level_state,
    make_numpy_runner,
)
from policy.errors import NoChunkError, PolicyError
from policy.loading.load import load_policy, read_policy_contract
from policy.loading.request import PolicyRequest
from policy.protocol import PolicyRunner

SMALL = Contract(arrays="numpy", image_height=32, image_width=32)
CLOCK = MonotonicClock()
PATIENT_S = 20.0
"""Longest wait of a test for something that another thread does."""
CONTRACT = """
[contract]
modes = ["LOITER"]
image_height = 32
image_width = 32
max_state_age_s = 0.5
max_velocity_age_s = 0.5
max_feature_age_s = 0.5
"""


@pytest.fixture
def contract_file(tmp_path: Path) -> Path:
    path = tmp_path / "contract.toml"
    path.write_text(CONTRACT)
    return path


@pytest.fixture(autouse=True)
def no_thread_stays() -> Iterator[None]:
    yield
    left = [thread.name for thread in threading.enumerate() if "server-link" in thread.name]
    assert left == []


def loaded(port: int, contract_file: Path) -> "closing[RemotePolicy]":
    policy, notes = load_server_policy(f"ws://127.0.0.1:{port}", contract_file)
    assert "longer than 500 ms is not flown" in notes[0]
    policy.reset()
    return closing(policy)


def predict(policy: RemotePolicy) -> float:
    """The value that a scripted server gives to all of a chunk."""
    contract = policy.contract
    image = np.zeros((1, *contract.image_shape), np.float32)
    history = np.zeros((1, contract.history_len, 4), np.float32)
    chunk = policy.predict(image, level_state(contract), history, 10)
    assert chunk.shape == (1, contract.horizon, 4)
    assert (chunk == chunk[0, 0, 0]).all()
    return float(chunk[0, 0, 0])


def predict_until(policy: RemotePolicy, is_good: Callable[[float | str], bool]) -> None:
    """Ask again and again for a chunk, as a flight does, until its value or its error is good."""
    ends_ns = CLOCK.now_ns() + round(PATIENT_S * NS_PER_S)
    while CLOCK.now_ns() < ends_ns:
        try:
            outcome: float | str = predict(policy)
        except NoChunkError as error:
            outcome = str(error)
        if is_good(outcome):
            return
        threading.Event().wait(0.01)
    raise AssertionError(f"still {outcome}")


def test_a_late_answer_is_never_flown(contract_file: Path) -> None:
    guard = Guard()
    with scripted_server(guard.reply) as port, loaded(port, contract_file) as policy:
        tried = guard.requests
        assert predict(policy) == tried + 1
        guard.is_open.clear()
        begun_ns = CLOCK.now_ns()
        with pytest.raises(NoChunkError, match="has not answered within 500 ms"):
            predict(policy)
        assert 0.4 < (CLOCK.now_ns() - begun_ns) / NS_PER_S < 5.0
        guard.is_open.set()
        # The answer to the request before is thrown away: this is the one to the newest.
        predict_until(policy, lambda value: value == guard.requests)
        assert guard.requests >= tried + 3


def test_an_answer_that_nobody_asked_for_is_not_flown_in_place_of_the_next(
    contract_file: Path,
) -> None:
    guard = Guard()

    def reply(message: Message) -> Reply:
        answer = guard.reply(message)
        return (answer, answer) if guard.requests == 3 else answer

    with scripted_server(reply) as port, loaded(port, contract_file) as policy:
        assert predict(policy) == guard.requests == 3
        predict_until(policy, lambda outcome: "nobody asked for" in str(outcome))
        predict_until(policy, lambda value: value == guard.requests)


def test_answers_are_timed_and_a_flight_that_ends_takes_its_leave(
    contract_file: Path,
) -> None:
    codes: Queue[int | None] = Queue()
    with scripted_server(lambda _: chunk_of(0.5), on_close=codes.put) as port:
        with loaded(port, contract_file) as policy:
            assert predict(policy) == 0.5
            assert 0 < policy._link.round_trip_s < PATIENT_S
        assert codes.get(timeout=PATIENT_S) == 1000


def test_a_server_that_comes_back_is_flown_again(contract_file: Path) -> None:
    with scripted_server(lambda _: chunk_of(0.1)) as port:
        policy, _ = load_server_policy(f"ws://127.0.0.1:{port}", contract_file)
    with closing(policy):
        policy.reset()
        predict_until(policy, lambda found: "nobody listens" in str(found))
        with scripted_server(lambda _: chunk_of(0.2), port=port):
            predict_until(policy, lambda found: found == pytest.approx(0.2))


@pytest.mark.parametrize("is_ours", [True, False])
def test_a_server_of_another_policy_is_not_flown(contract_file: Path, is_ours: bool) -> None:
    def reply(_: Message) -> Reply:
        return chunk_of(0.2)

    rgb, bgr = (
        pack({"mavbridge_fields": json.dumps({"image_channels": each})}) for each in ("rgb", "bgr")
    )
    with our_server(served_echo()) if is_ours else scripted_server(reply, greeting=rgb) as at:
        policy, _ = load_server_policy(f"ws://127.0.0.1:{at}", None if is_ours else contract_file)
    with closing(policy), scripted_server(reply, port=at, greeting=bgr):
        predict_until(policy, lambda found: "serves another policy now" in str(found))


def test_a_server_that_falls_silent_is_connected_to_again(
    contract_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote_policy, "LOST_S", 0.05)
    monkeypatch.setattr(remote_policy, "MOST_WAIT_S", 0.05)
    guard = Guard()
    with scripted_server(guard.reply) as port:
        policy, _ = load_server_policy(f"ws://127.0.0.1:{port}", contract_file)
        with closing(policy):
            policy.reset()
            guard.is_open.clear()
            predict_until(policy, lambda found: "connecting again" in str(found))
            guard.is_open.set()
            predict_until(policy, lambda found: found == guard.requests)


@pytest.mark.parametrize(
    ("reply", "told"),
    [
        ("Traceback:\n  File x\nKeyError: 'image'", "the policy server failed: KeyError: 'image'"),
        (b"garbage", "not a msgpack map"),
        (pack({"action_chunk": [1]}), "no 'actions' in it; it has"),
        (chunk_of(0.1, horizon=50), r"actions \[50, 4\].*\[16, 4\]: set .* horizon"),
        (pack({"actions": np.zeros((16, 7))}), r"actions \[16, 7\] .*: the server has to cut out"),
        (pack({"actions": "left"}), "no array of numbers"),
        (None, "has closed the connection|is lost"),
    ],
)
def test_what_is_no_chunk_is_refused_at_loading_and_coasted_over_in_flight(
    reply: bytes | str | None, told: str, contract_file: Path
) -> None:
    answers: list[bytes | str | None] = [chunk_of(0.5)]
    with (
        scripted_server(lambda _: answers[0]) as port,
        loaded(port, contract_file) as policy,
    ):
        answers[0] = reply
        with pytest.raises(NoChunkError, match=told):
            predict(policy)
        with pytest.raises(PolicyError, match=told):
            load_server_policy(f"ws://127.0.0.1:{port}", contract_file)
        answers[0] = chunk_of(0.75)
        predict_until(policy, lambda found: found == 0.75)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ('{"horizon": 4, "image_height": 32, "modes": ["LOITER"]}', None),
        ('{"image_height": 48}', "image_height = 32 contradicts"),
        ('{"height": 48}', "unknown contract keys"),
        ("[]", "not a JSON object"),
        ("{", "not JSON"),
        ("[" * 100_000, "nested too deeply"),
        ({"horizon": 4}, "mavbridge_fields must be JSON as text, got a dict"),
        (b"{}", "mavbridge_fields must be JSON as text, got a bytes"),
    ],
)
def test_a_server_may_say_fields_that_the_file_lacks(
    contract_file: Path, fields: object, told: str | None
) -> None:
    greeting = pack({"mavbridge_fields": fields})
    with scripted_server(lambda _: pack({"actions": [[0.5] * 4] * 4}), greeting=greeting) as port:
        url = f"ws://127.0.0.1:{port}"
        if told is not None:
            with pytest.raises(PolicyError, match=told):
                load_server_policy(url, contract_file)
            return
        policy, _ = load_server_policy(url, contract_file)
        with closing(policy):
            assert (policy.contract.horizon, predict(policy)) == (4, 0.5)
        both = 'cameras = ["front", "down"]\n[images]\nfront = "image"\ndown = "image"\n'
        of_state = '[images]\nfront = "observation"\n[state]\nkey = "observation"\n'
        of_prompt = '[state]\nkey = "prompt"\n[task]\nprompt = "fly"\n'
        for more, keys in (
            (both, "image, image"),
            (of_state, "observation"),
            (of_prompt, "prompt"),
        ):
            contract_file.write_text(CONTRACT + more)
            with pytest.raises(PolicyError, match=f"several inputs would have one key: .*{keys}"):
                load_server_policy(url, contract_file)


def test_addresses_without_a_policy_server(
    contract_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote_policy, "CONNECT_S", 0.5)
    with pytest.raises(PolicyError, match=r"nobody listens .* start the policy server"):
        load_server_policy(f"ws://127.0.0.1:{free_port(socket.SOCK_STREAM)}", None)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"ws://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(PolicyError, match="has not answered like a policy server"):
            load_server_policy(url, contract_file)
    for greeting in ("hello", b"\x00 no map"):
        with (
            scripted_server(lambda _: chunk_of(0.5), greeting=greeting) as port,
            pytest.raises(PolicyError, match="is no policy server, its first message"),
        ):
            load_server_policy(f"ws://127.0.0.1:{port}", contract_file)
    for metadata, told in (
        ({}, "give --contract FILE; docs/policy_server.md"),
        ({"mavbridge_contract": {}}, "mavbridge_contract must be JSON as text, got a dict"),
    ):
        with (
            scripted_server(lambda _: chunk_of(0.5), greeting=pack(metadata)) as port,
            pytest.raises(PolicyError, match=told),
        ):
            read_policy_contract(PolicyRequest(spec=f"ws://127.0.0.1:{port}"))


def test_the_deadline_is_what_the_guard_would_fly() -> None:
    def contract(age_s: float, play_s: float) -> Contract:
        return Contract(
            max_state_age_s=age_s, max_velocity_age_s=1.0, max_feature_age_s=1.0, play_s=play_s
        )

    assert answer_deadline_s(contract(0.1, 0.0)) == pytest.approx(0.1)
    assert answer_deadline_s(contract(0.1, 0.4)) == pytest.approx(0.5)
    assert answer_deadline_s(contract(1.0, 0.5)) == pytest.approx(0.8)  # the whole chunk
    assert answer_deadline_s(contract(5.0, 0.0)) == pytest.approx(0.8)


class Echo:
    """Puts everything it is given into its actions, and counts its resets."""

    contract = SMALL

    def __init__(self) -> None:
        self.resets = 0

    def predict(
        self, image: FloatArray, state: FloatArray, action_history: FloatArray, steps: int
    ) -> FloatArray:
        chunk = np.zeros((1, 16, 4), np.float32)
        chunk[0, :13, 0] = state[0]
        chunk[0, :4, 1:] = action_history[0, :, 1:]
        chunk[0, 4:8, 1] = image[0].mean(), image[0].std(), image[0, 0, 3, 7], image[0, 2, 9, 1]
        return chunk

    def reset(self) -> None:
        self.resets += 1


def sample(runner: PolicyRunner, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng, contract = np.random.default_rng(seed), runner.contract
    rgb = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    state = rng.normal(size=(1, *contract.state_shape)).astype(np.float32)
    history = rng.uniform(-1, 1, (1, contract.history_len, 4)).astype(np.float32)
    return encode_all(runner, rgb), state, history


@pytest.mark.parametrize("name", ["echo", "toge"])
def test_a_served_policy_flies_the_same_sticks_as_here(name: str) -> None:
    """To the last bit; TOGE by its shipped weights, in float32 on torch."""
    if name == "toge":
        request = PolicyRequest(spec="toge", engine="torch", dual_rate=False, num_diffusion_steps=2)
        here = load_policy(request, now_s=lambda: 0.0).runner
    else:
        here = make_numpy_runner(Echo(), ExecutionSettings(name="echo", dual_rate=False))
    with our_server(here) as port:
        policy, _ = load_server_policy(f"ws://127.0.0.1:{port}", None)
        settings = ExecutionSettings(name="served", dual_rate=False)
        there = make_numpy_runner(policy, settings)
        with closing(policy):
            assert there.contract.image_shape == here.contract.image_shape
            for seed in range(3):
                inputs = sample(here, seed)
                assert np.array_equal(inputs[0], sample(there, seed)[0])
                assert np.array_equal(there.act(*inputs), here.act(*inputs))


def test_a_contract_file_says_when_a_served_policy_may_fly(tmp_path: Path) -> None:
    path = tmp_path / "contract.toml"
    path.write_text("[contract]\nplay_s = 0.25\nmax_state_age_s = 0.15\n")
    with our_server(served_echo()) as port:
        request = PolicyRequest(spec=f"ws://127.0.0.1:{port}", contract_file=path)
        contract = read_policy_contract(request)
        assert contract == replace(SMALL, play_s=0.25, max_state_age_s=0.15)
        for refused, told in (
            ("[contract]\nimage_height = 64\n", "contradicts the policy's own files, which say 32"),
            ("[action]\nscale = [2.0, 1.0, 1.0, 1.0]\n", r"leave out \[action\]: the server"),
            ("contract = 3\n", r"\['contract'\] must stand in a table"),
            ("[state]\n[images]\n", r"leave out \[state\], \[images\]: the server"),
        ):
            path.write_text(refused)
            with pytest.raises(PolicyError, match=told):
                read_policy_contract(request)
    served = json.dumps({"action": "rates", "horizon": 100, "image_height": 32})
    greetings = {"mavbridge_contract": served}, {"mavbridge_fields": served}
    path.write_text('[contract]\nmodes = ["OFFBOARD"]\nplay_s = 2.0\n')
    for greeting in map(pack, greetings):
        with scripted_server(lambda _: chunk_of(0.5, horizon=100), greeting=greeting) as port:
            contract = read_policy_contract(replace(request, spec=f"ws://127.0.0.1:{port}"))
            assert (contract.modes, contract.play_s, contract.horizon) == (("OFFBOARD",), 2.0, 100)


def test_no_chunk_is_flown_before_a_reset_has_succeeded() -> None:
    policy, failures = Echo(), ["device busy", "device busy"]

    def reset() -> None:
        if failures:
            raise PolicyError(failures.pop())
        policy.reset()

    runner = make_numpy_runner(policy, ExecutionSettings(name="echo", dual_rate=False))
    with our_server(replace(runner, reset=reset)) as port:
        remote, _ = load_server_policy(f"ws://127.0.0.1:{port}", None)
        with closing(remote):
            inputs = sample(runner, 0)
            remote.predict(*inputs, 10)
            assert (policy.resets, len(failures)) == (0, 2), "no flight has begun"
            remote.reset()
            remote._timeout_s = PATIENT_S  # type: ignore[attr-defined]
            for _ in range(2):
                with pytest.raises(NoChunkError, match="device busy"):
                    remote.predict(*inputs, 10)
            for _ in range(2):
                remote.predict(*inputs, 10)
            assert (policy.resets, failures) == (1, [])


def served_echo() -> PolicyRunner:
    return make_numpy_runner(Echo(), ExecutionSettings(name="echo", dual_rate=False))


def connect(port: int, **headers: str) -> Any:
    return websockets.sync.client.connect(
        f"ws://127.0.0.1:{port}",
        compression=None,
        max_size=None,
        proxy=None,
        additional_headers=headers,
    )


def test_our_server_keeps_the_protocol_of_openpi() -> None:
    """As its reference client speaks: first metadata, then chunks, and texts for errors."""
    request = {
        "observation.images.front": np.zeros((32, 32, 3), np.uint8),
        "observation.state": np.arange(13, dtype=np.float64),
        "action_history": np.zeros((4, 4), np.float32),
    }
    with our_server(served_echo()) as port, connect(port) as client:
        metadata = unpack(client.recv(PATIENT_S))
        assert Contract.from_json(str(metadata["mavbridge_contract"])) == SMALL
        for bad, told in (
            (b"garbage", "not a msgpack map"),
            (pack({"observation/image": 1}), "no 'observation.images.front' in it"),
            (pack({**request, "observation.state": np.zeros(3)}), "[13]"),
            (pack({**request, "reset": np.array([1, 1])}), "'reset' must be true or false"),
            ("text", "a text in place"),
            (pack(request), None),
        ):
            client.send(bad)
            answer = client.recv(PATIENT_S)
            if told is not None:
                assert told in str(answer)
                continue
            message: Any = unpack(answer)
            actions = number_array(message, "actions")
            assert (actions.shape, actions.dtype) == ((16, 4), np.float32)
            assert actions[:13, 0].tolist() == list(range(13))
            assert message["server_timing"]["infer_ms"] > 0


def test_our_server_bounds_clients_and_requests() -> None:
    with our_server(served_echo()) as port, ExitStack() as stack:
        clients = [stack.enter_context(connect(port)) for _ in range(5)]
        greeted = [client.recv(PATIENT_S) for client in clients[:4]]
        assert len(greeted) == 4
        with pytest.raises(ConnectionClosed, match="all 4 connections are in use"):
            clients[4].recv(PATIENT_S)
        clients[0].send(b"\0" * 4 * 2**20)
        with pytest.raises(ConnectionClosed, match="1009"):
            clients[0].recv(PATIENT_S)
        url = f"http://127.0.0.1:{port}/healthz"
        with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(url) as response:
            assert (response.status, response.read()) == (200, b"OK\n")
    depth = replace(SMALL, image_channels="depth", image_height=640, image_width=960)
    runner = replace(served_echo(), contract=depth, act=lambda *_: np.zeros((1, 16, 4), np.float32))
    with our_server(runner) as port:  # 2.5 MB of float32 an image
        assert read_policy_contract(PolicyRequest(spec=f"ws://127.0.0.1:{port}")) == depth


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:8000", ""])
def test_a_web_page_is_refused_and_holds_no_place(origin: str) -> None:
    remembers = replace(served_echo(), reset=lambda: None)
    with our_server(remembers) as port:
        with pytest.raises(InvalidStatus, match="403"):
            connect(port, Origin=origin).__enter__()
        with connect(port) as client:
            assert unpack(client.recv(PATIENT_S))


def test_a_server_with_a_key_lets_in_who_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    with our_server(served_echo(), api_key="secret") as port:
        url = f"ws://127.0.0.1:{port}"
        for key in ("", "wrong"):
            monkeypatch.setenv(remote_policy.API_KEY_VARIABLE, key)
            with pytest.raises(PolicyError, match=r"wants an API key.* MAVBRIDGE_API_KEY"):
                load_server_policy(url, None)
        twice = dict.fromkeys(("Authorization", "authorization"), "Api-Key secret")
        for headers in ({"Authorization": "Api-Key other"}, twice):
            with pytest.raises(InvalidStatus, match="401"):
                connect(port, **headers).__enter__()
        monkeypatch.setenv(remote_policy.API_KEY_VARIABLE, "secret")
        assert read_policy_contract(PolicyRequest(spec=url)).image_height == 32
        with connect(port, Authorization="Api-Key secret") as client:
            assert unpack(client.recv(PATIENT_S))


def test_the_command_serves_until_it_is_told_to_stop_whatever_its_terminal_does() -> None:
    port = free_port(socket.SOCK_STREAM)
    command = [sys.executable, "-m", "mavbridge", "serve", "--policy", "scripted:hover:velocity"]
    command += ["--port", str(port)]
    shown, terminal = os.openpty()
    with (
        os.fdopen(shown, errors="replace") as lines,
        subprocess.Popen(command, stdout=terminal, stderr=terminal) as process,
    ):
        os.close(terminal)
        ends = threading.Timer(PATIENT_S * 3, process.kill)
        ends.start()
        try:
            assert any(f"at ws://127.0.0.1:{port}" in line for line in lines)
            os.write(shown, b"\x13")  # Ctrl-S
            for _ in range(2):
                contract = read_policy_contract(PolicyRequest(spec=f"ws://127.0.0.1:{port}"))
                assert (contract.action, contract.arrays) == ("velocity", "numpy")
            process.send_signal(signal.SIGINT)
            assert process.wait(PATIENT_S) == 0
        finally:
            ends.cancel()
            process.kill()
