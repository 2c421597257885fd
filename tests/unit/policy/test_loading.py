import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.loaded_policies import act, load
from policy.checkpoints.networks import save_checkpoint
from policy.contract import Contract, FloatArray
from policy.engines.runner import level_state
from policy.errors import NoChunkError, PolicyError, Warned
from policy.loading.builtin import SHIPPED
from policy.loading.load import read_policy_contract
from policy.loading.request import PolicyRequest, measure_times
from policy.motion.stick_loop import StickLoop, by_rates
from policy.nets.toge import Toge
from policy.protocol import PolicyRunner


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
    runner = load(spec, starts_in_air=starts_in_air, image_size=64).runner
    assert (runner.contract.action, runner.contract.image_height) == (action, 64)
    assert runner.dual_rate
    first = act(runner)[0]
    if climbs is not None:
        assert bool((-first[2] if action == "velocity" else first[0]) > 0.2) is climbs


def test_neither_scripted_policies_nor_cheap_checks_import_torch_nor_a_flight_rerun() -> None:
    program = (
        "import sys, mavbridge.flight.app; from policy.loading.request import PolicyRequest; "
        "from policy.loading.load import check_request, load_policy; "
        "check_request(PolicyRequest(spec='toge')); "
        "load_policy(PolicyRequest(spec='scripted:square'), now_s=lambda: 0.0); "
        "sys.exit(bool({'torch', 'rerun'} & {*sys.modules}))"
    )
    result = subprocess.run([sys.executable, "-c", program], timeout=60, check=False)
    assert result.returncode == 0


def test_untrained_weights_are_seeded_and_said() -> None:
    torch_state = torch.random.get_rng_state()
    flags: dict[str, Any] = {"allow_untrained": True, "image_size": 32, "engine": "torch"}
    first, again, other = (load("toge:small:resnet8", seed=seed, **flags) for seed in (3, 3, 4))
    assert "untrained: seeded random weights (seed 3, noise too)" in first.notes[0]
    np.testing.assert_array_equal(act(first.runner), act(again.runner))
    assert not np.array_equal(act(first.runner), act(other.runner))
    assert torch.equal(torch.random.get_rng_state(), torch_state)


def test_a_checkpoint_decides_what_is_built(checkpoint: Path, small_toge: Toge) -> None:
    for spec in ("toge", "toge:small:resnet8"):
        loaded = load(spec, checkpoint=checkpoint, engine="torch")
        assert loaded.runner.contract == small_toge.contract
        assert "(small, resnet8)" in loaded.notes[0]
    for spec in ("toge:medium", "toge:resnet18"):
        with pytest.raises(PolicyError, match="holds small:resnet8"):
            load(spec, checkpoint=checkpoint)


@pytest.mark.parametrize(
    ("spec", "changes", "message"),
    [
        ("vla", {}, "package.module:Class"),
        ("scripted", {"checkpoint": Path("a.pt")}, "no weights"),
        ("toge:resnet50:small", {"allow_untrained": True}, "does not take 'resnet50:small'"),
        ("toge", {"checkpoint": Path("weights.bin")}, "not a checkpoint"),
        ("toge", {"image_size": 64}, "network.image_size=64 contradicts"),
        ("toge:resnet18", {"allow_untrained": True, "image_size": 1}, "image_height"),
        ("toge", {"allow_untrained": True, "device": "tpu"}, "this computer has"),
        ("scripted:yaw", {"engine": "openvino"}, "computes in numpy"),
        ("toge", {"allow_untrained": True, "num_diffusion_steps": 101}, r"1\.\.100"),
        ("json.decoder:Nothing", {}, "no class Nothing"),
        ("policy:Mine", {}, "a file of that name flies by its path: --policy ./policy.py:Mine"),
        ("scripted:yaw", {"by_rates": True}, "--by-rates is for toge"),
        ("toge-rates", {"checkpoint": SHIPPED}, "toge.safetensors flies by sticks, not by rates"),
        ("toge-rates", {"allow_untrained": True}, "no untrained toge-rates"),
    ],
)
def test_refusals_name_the_next_step(spec: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(PolicyError, match=message):
        load(spec, **changes)


def test_sticks_are_flown_by_rates_where_that_is_asked_for(checkpoint: Path) -> None:
    sticks, rates = (
        load("toge", checkpoint=checkpoint, engine="torch", by_rates=asked).runner
        for asked in (False, True)
    )
    contract = rates.contract
    assert contract == by_rates(sticks.contract)
    request = PolicyRequest(spec="toge", checkpoint=checkpoint, by_rates=True)
    assert read_policy_contract(request) == contract
    flown = StickLoop(contract).to_rates(act(sticks)[None], level_state(contract))
    np.testing.assert_allclose(act(rates)[None], flown, atol=1e-6)


@pytest.mark.parametrize(
    ("act_s", "clock_runs", "encode_s", "told_s"),
    [
        ([0.004, 0.2, 0.004, 0.005, 0.006], True, 0.01, 0.005),
        ([0.5], True, 0.01, 0.5),
        ([0.5], False, 0.0, 0.0),
        ([None], True, None, None),
    ],
    ids=["one slow repetition", "a slow policy", "a clock that stands still", "no chunk yet"],
)
def test_a_policy_is_timed_by_the_median_of_as_few_chunks_as_tell(
    act_s: list[float | None], clock_runs: bool, encode_s: float | None, told_s: float | None
) -> None:
    now_s, times = 7.0, iter(act_s)

    def encode(rgb: object, camera: int = 0, /) -> FloatArray:
        nonlocal now_s
        now_s += 0.01 * clock_runs
        return np.zeros((1, 1), np.float32)

    def act(*_: object) -> FloatArray:
        nonlocal now_s
        if (took_s := next(times)) is None:
            raise NoChunkError("the server is not there yet")
        now_s += took_s * clock_runs
        return np.zeros((1, 16, 4), np.float32)

    contract = Contract(feature_dim=1, arrays="numpy")
    parts: dict[str, Any] = {"dual_rate": True, "encode": encode, "act": act}
    runner = PolicyRunner(contract=contract, name="test", engine="numpy", **parts)
    told = measure_times(runner, lambda: now_s)
    if told is None:
        assert told_s is None
    else:
        assert (told.encode_s, told.act_s) == pytest.approx((encode_s, told_s))
    assert list(times) == [], "asked as often as that"


UNITS = """
import numpy as np
from policy.contract import Contract

class Mine:
    contract = Contract(arrays="numpy", horizon=2, action="{action}")

    def predict(self, image, state, action_history, num_diffusion_steps):
        forward, rate = state[0, 0], state[0, 7]
        return np.tile(np.array([{actions}], np.float32), (1, 2, 1))
"""


@pytest.mark.parametrize(
    ("action", "actions", "told"),
    [
        ("sticks", "1500, 1500, 1500 + forward, 1500", "reach throttle 1500, yaw 1500, pitch 1502"),
        ("sticks", "0, 0, 50 * forward, 0", "its sticks reach pitch 100, far beyond"),
        ("sticks", "0, 0, forward, -2 * forward", None),
        ("attitude", "0.4, 5 * forward, 0, 0", "its attitude reach roll_rad 10"),
        ("attitude", "0.4, 0.2 * forward, 0, 0", None),
        ("rates", "0.4, 57 * rate, 0, 0", "its rates reach roll_rate_radps 28.5"),
        ("rates", "0.4, 4 * rate, 0, 0", None),
        ("velocity", "100 * forward, 0, 0, 0", "its velocity reach vx_mps 200"),
        ("velocity", "2 * forward, 0, 0, 0", None),
    ],
)
def test_actions_of_another_unit_are_warned_of(tmp_path, action, actions, told):
    """A level vehicle at rest does not show degrees: zero is zero in all units."""
    (tmp_path / "mine.py").write_text(UNITS.format(action=action, actions=actions))
    warnings = [note for note in load(f"{tmp_path / 'mine.py'}:Mine").notes if "units" in note]
    assert len(warnings) == (told is not None)
    assert told is None or (isinstance(warnings[0], Warned) and told in warnings[0])
