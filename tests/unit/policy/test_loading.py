import copy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from policy.checkpoints.networks import save_checkpoint
from policy.contract import Contract, FloatArray
from policy.errors import NoChunkError, PolicyError
from policy.loading.load import check_request, load_policy, read_policy_contract
from policy.loading.request import LoadedPolicy, PolicyRequest, SolveTimes, measure_times
from policy.motion.stick_loop import StickLoop, by_rates, rates_contract
from policy.nets.toge import ResnetUnetConfig, Toge, build_policy
from policy.protocol import PolicyRunner

RGB = np.full((48, 64, 3), 90, np.uint8)
STATE = np.eye(1, 13, 3, dtype=np.float32)
HISTORY = np.zeros((1, 4, 4), np.float32)


def load(spec: str, **changes: Any) -> LoadedPolicy:
    # Policies that compute in numpy have no choice of engines.
    engine = "auto" if spec.startswith("scripted") else "torch"
    request = PolicyRequest(**{"spec": spec, "engine": engine, "num_diffusion_steps": 2, **changes})
    return load_policy(request, now_s=lambda: 0.0)


def act(loaded: LoadedPolicy) -> np.ndarray:
    runner = loaded.runner
    return runner.act(runner.encode(RGB), STATE, HISTORY)


@pytest.fixture(scope="module")
def checkpoint(small_toge: Toge, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("loading") / "toge.safetensors"
    save_checkpoint(path, small_toge)
    return path


@pytest.mark.parametrize(
    ("spec", "starts_in_air", "action", "climbs"),
    [
        ("scripted", False, "sticks", True),
        ("scripted", True, "sticks", False),
        ("scripted:hover:velocity:air", True, "velocity", False),
        ("scripted:hover:velocity", False, "velocity", True),
        ("scripted:doublet:rates:air", False, "rates", None),
    ],
)
def test_scripted_programs_fly_without_weights(spec, starts_in_air, action, climbs):
    loaded = load(spec, starts_in_air=starts_in_air, image_size=64)
    contract = loaded.runner.contract
    assert (contract.action, contract.image_height) == (action, 64)
    assert loaded.runner.dual_rate
    first = act(loaded)[0, 0]
    if climbs is not None:
        assert bool((-first[2] if action == "velocity" else first[0]) > 0.2) is climbs


def test_torch_is_imported_by_neither_scripted_policies_nor_cheap_checks() -> None:
    program = (
        "import sys; from policy.loading.request import PolicyRequest; "
        "from policy.loading.load import check_request, load_policy; "
        "check_request(PolicyRequest(spec='toge')); "
        "load_policy(PolicyRequest(spec='scripted:square'), now_s=lambda: 0.0); "
        "sys.exit('torch' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", program], timeout=60, check=False)
    assert result.returncode == 0


def test_untrained_weights_are_seeded_and_said() -> None:
    torch_state = torch.random.get_rng_state()
    first, again, other = (
        load("toge:small:resnet8", allow_untrained=True, image_size=32, seed=seed)
        for seed in (3, 3, 4)
    )
    assert "untrained: seeded random weights (seed 3, noise too)" in first.notes[0]
    np.testing.assert_array_equal(act(first), act(again))
    assert not np.array_equal(act(first), act(other))
    assert torch.equal(torch.random.get_rng_state(), torch_state)


def test_the_fastest_engine_that_agrees_flies_and_is_named(checkpoint: Path) -> None:
    fast, reference = (
        load("toge", checkpoint=checkpoint, engine=engine) for engine in ("auto", "torch")
    )
    assert fast.runner.engine.startswith("openvino")
    assert any("agrees with torch" in note for note in fast.notes)
    np.testing.assert_allclose(act(fast), act(reference), atol=0.01)


def test_a_checkpoint_decides_what_is_built(checkpoint: Path, small_toge: Toge) -> None:
    for spec in ("toge", "toge:small:resnet8"):
        loaded = load(spec, checkpoint=checkpoint)
        assert loaded.runner.contract == small_toge.contract
        assert "(small, resnet8)" in loaded.notes[0]
    for spec in ("toge:medium", "toge:resnet18"):
        with pytest.raises(PolicyError, match="holds small:resnet8"):
            load(spec, checkpoint=checkpoint)


def test_a_policy_without_fast_path_becomes_single_rate_with_one_warning(tmp_path: Path) -> None:
    contract = Contract(image_height=32, image_width=32)
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, build_policy(ResnetUnetConfig(contract=contract)))
    asked, not_asked = (
        load("resnet-unet", checkpoint=path, dual_rate=dual_rate) for dual_rate in (True, False)
    )
    assert not asked.runner.dual_rate
    (warning,) = (note for note in asked.notes if note.startswith("warning"))
    assert "resnet-unet has no fast path" in warning
    assert not any(note.startswith("warning") for note in not_asked.notes)
    assert act(asked).shape == (1, 16, 4)


@pytest.mark.parametrize(
    ("spec", "changes", "message"),
    [
        ("vla", {}, "package.module:Class"),
        ("scripted:loop", {}, "square"),
        ("scripted:square:position", {}, "velocity"),
        ("scripted", {"checkpoint": Path("a.pt")}, "no weights"),
        ("toge:huge", {"allow_untrained": True}, "neither a size"),
        ("resnet-unet:resnet50", {"allow_untrained": True}, "does not take 'resnet50'"),
        ("toge", {"checkpoint": Path("absent.safetensors")}, "no such file"),
        ("toge:resnet18", {"allow_untrained": True, "image_size": 1}, "image_height"),
        ("resnet-unet", {"allow_untrained": True, "device": "tpu"}, "this computer has"),
        ("scripted:yaw", {"engine": "openvino"}, "computes in numpy"),
        ("resnet-unet", {"allow_untrained": True, "num_diffusion_steps": 101}, r"1\.\.100"),
        ("json.decoder:Nothing", {}, "no class Nothing"),
        ("policy:Mine", {}, "a file of that name flies by its path: --policy ./policy.py:Mine"),
        ("scripted:yaw", {"by_rates": True}, "--by-rates is for toge"),
    ],
)
def test_refusals_name_the_next_step(spec: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(PolicyError, match=message):
        load(spec, **changes)


def test_sticks_are_flown_by_rates_where_that_is_asked_for(checkpoint: Path) -> None:
    sticks = load("toge", checkpoint=checkpoint)
    rates = load("toge", checkpoint=checkpoint, by_rates=True)
    contract = rates.runner.contract
    assert contract == by_rates(sticks.runner.contract)
    request = PolicyRequest(spec="toge", checkpoint=checkpoint, by_rates=True)
    assert read_policy_contract(request) == contract
    flown = StickLoop(contract).to_rates(act(sticks), STATE)
    np.testing.assert_allclose(act(rates), flown, atol=1e-6)


def test_weights_that_learned_from_rates_are_flown_by_them(small_toge, checkpoint, tmp_path):
    network = copy.deepcopy(small_toge)
    network.contract = rates_contract(network.contract)
    network.config = replace(network.config, contract=network.contract)
    path = tmp_path / "rates.safetensors"
    save_checkpoint(path, network)
    loaded = load("toge", checkpoint=path)
    assert loaded.runner.contract == network.contract
    flown = StickLoop(network.contract).to_rates(act(load("toge", checkpoint=checkpoint)), STATE)
    np.testing.assert_allclose(act(loaded), flown, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"checkpoint": Path("weights.bin")}, "not a checkpoint"),
        ({"image_size": 64}, "network.image_size=64 contradicts"),
        ({"spec": "toge:medium", "checkpoint": None}, "network.allow_untrained"),
    ],
)
def test_cheap_checks_refuse_without_loading(checkpoint, changes, message):
    good = {"spec": "toge", "checkpoint": checkpoint}
    check_request(PolicyRequest(**good))
    with pytest.raises(PolicyError, match=message):
        check_request(PolicyRequest(**{**good, **changes}))


class Timed:
    """A policy whose calls take the given times, one after the other."""

    def __init__(self, act_s: list[float], contract: Contract) -> None:
        self.now_s = 0.0
        self._act_s = act_s
        self.acts = 0
        self.runner = PolicyRunner(
            contract=contract,
            name="test",
            engine="numpy",
            dual_rate=True,
            encode=self._encode,
            act=self._act,
        )

    def _encode(self, rgb: object, camera: int = 0, /) -> FloatArray:
        self.now_s += 0.01
        return np.zeros((1, 1), np.float32)

    def _act(self, encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        self.now_s += self._act_s[min(self.acts, len(self._act_s) - 1)]
        self.acts += 1
        return np.zeros((1, 16, 4), np.float32)


ONE = Contract(feature_dim=1, arrays="numpy")


def test_one_slow_repetition_does_not_make_a_policy_slow() -> None:
    timed = Timed([0.004, 0.2, 0.004, 0.005, 0.006], ONE)
    times = measure_times(timed.runner, lambda: timed.now_s)
    assert times == SolveTimes(encode_s=pytest.approx(0.01), act_s=pytest.approx(0.005))


def test_a_slow_policy_and_a_clock_that_stands_still_are_asked_once() -> None:
    timed = Timed([0.5], ONE)
    assert measure_times(timed.runner, lambda: timed.now_s) == SolveTimes(
        encode_s=pytest.approx(0.01), act_s=0.5
    )
    assert timed.acts == 1
    assert measure_times(timed.runner, lambda: 7.0) == SolveTimes(encode_s=0.0, act_s=0.0)
    assert timed.acts == 2


def test_without_a_chunk_there_is_no_time_of_one() -> None:
    def act(*inputs: object) -> FloatArray:
        raise NoChunkError("the server is not there yet")

    runner = replace(Timed([], ONE).runner, act=act)
    assert measure_times(runner, lambda: 0.0) is None
