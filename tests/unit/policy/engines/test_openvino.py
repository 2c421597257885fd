"""The OpenVINO engine against plain torch, on a CPU; every graph is compiled once per test run."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from policy.checkpoints.policy_file import BuiltinConfig, BuiltinPolicy, build_policy
from policy.contract import Contract, FloatArray
from policy.engines import openvino_cpu
from policy.engines.choose import chunks_of_samples
from policy.engines.openvino_compile import precisions
from policy.engines.openvino_cpu import BulkEncoder, make_openvino_runner
from policy.engines.parity import make_parity_samples
from policy.engines.runner import ExecutionSettings, Precision
from policy.engines.torch_eager import make_torch_runner
from policy.errors import PolicyError
from policy.nets.diffusion import NoiseSchedule
from policy.nets.names import BACKBONE_NAMES, BackboneName
from policy.nets.resnet_unet import ResnetUnetConfig
from policy.nets.toge import Toge, TogeConfig
from policy.protocol import PolicyRunner

SMALL = Contract(image_height=32, image_width=32)
SETTINGS = ExecutionSettings(name="toge", num_diffusion_steps=2)


def seeded(config: BuiltinConfig) -> BuiltinPolicy:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        policy = build_policy(config).eval()
    policy.seed_noise(3)
    return policy


def both(policy: BuiltinPolicy, settings: ExecutionSettings) -> tuple[FloatArray, FloatArray]:
    """Chunks by plain torch, and by OpenVINO in float32."""
    samples = make_parity_samples(policy.contract)
    reference = make_torch_runner(policy, settings)
    runner = make_openvino_runner(policy, settings, "f32", "f32")
    assert runner.engine == "openvino-f32"
    return chunks_of_samples(reference, samples), chunks_of_samples(runner, samples)


@pytest.fixture(scope="module")
def shipped(trained_toge: Toge) -> dict[tuple[Precision, Precision], PolicyRunner]:
    """The shipped policy in every precision of this CPU."""
    pairs = {*precisions(), ("f32", "f32")}
    return {pair: make_openvino_runner(trained_toge, SETTINGS, *pair) for pair in pairs}


@pytest.mark.parametrize("backbone", BACKBONE_NAMES)
def test_every_backbone_computes_what_torch_computes(backbone: BackboneName) -> None:
    policy = seeded(TogeConfig(backbone=backbone, contract=replace(SMALL, image_height=64)))
    images = torch.from_numpy(np.random.default_rng(0).normal(size=(3, 3, 64, 32))).float()
    with torch.inference_mode():
        expected = policy.backbone(images).numpy()
    encoded = BulkEncoder(policy, "f32")(images.numpy())
    np.testing.assert_allclose(encoded, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize(
    "config",
    [
        TogeConfig(size="large", backbone="resnet8", contract=SMALL),
        ResnetUnetConfig(contract=replace(SMALL, since_exposure=True)),
        TogeConfig(
            backbone="resnet18",
            contract=Contract(image_height=32, image_width=48, horizon=8, history_len=2),
            schedule=NoiseSchedule(prediction="epsilon", betas="linear", num_train_timesteps=50),
        ),
    ],
    ids=["large", "resnet-unet", "other-contract"],
)
def test_single_rate_computes_what_torch_computes(config: BuiltinConfig) -> None:
    settings = ExecutionSettings(name="toge", num_diffusion_steps=1, dual_rate=False)
    expected, chunks = both(seeded(config), settings)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(chunks, expected, atol=2e-3)


@pytest.mark.parametrize("prediction", ["sample", "epsilon"])
def test_segments_compute_what_a_whole_solve_on_torch_does(prediction, monkeypatch):
    """Five steps by a graph of two: the last segment is padded."""
    schedule = NoiseSchedule(prediction=prediction)
    policy = seeded(TogeConfig(backbone="resnet8", contract=SMALL, schedule=schedule))
    monkeypatch.setattr(openvino_cpu, "MAX_UNROLLED", 2)
    expected, chunks = both(policy, ExecutionSettings(name="toge", num_diffusion_steps=5))
    np.testing.assert_allclose(chunks, expected, atol=2e-3)


def test_every_precision_of_this_cpu_is_near(trained_toge, shipped):
    samples = make_parity_samples(trained_toge.contract)
    expected = chunks_of_samples(make_torch_runner(trained_toge, SETTINGS), samples)
    for (vision, _), runner in shipped.items():
        assert runner.engine.startswith(f"openvino-{vision}")
        # Three significant digits of bfloat16; whether that is near enough the check decides.
        assert np.abs(chunks_of_samples(runner, samples) - expected).max() < 0.05


def test_results_belong_to_the_caller(shipped):
    runner = shipped["f32", "f32"]
    samples = make_parity_samples(runner.contract)
    first = runner.encode(samples.rgb[0])
    kept = first.copy()
    second = runner.encode(samples.rgb[1])
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(first, kept)


def test_refuses_an_array_of_another_shape(shipped):
    runner = shipped["f32", "f32"]
    state = np.zeros((1, runner.contract.state_dim), np.float32)
    with pytest.raises(PolicyError, match=r"input 0 must be \[1, 256\], got \[1, 1\]"):
        runner.act(np.zeros((1, 1), np.float32), state, np.zeros((1, 4, 4), np.float32))


def cached(folder: Path) -> list[Path]:
    return sorted((folder / "mavbridge" / "openvino").glob("*.graph"))


def test_compiled_graphs_are_cached_and_damage_does_no_harm(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    policy = seeded(TogeConfig(backbone="resnet8", contract=SMALL))
    samples = make_parity_samples(SMALL)

    def chunks(seed: int = 0, steps: int = 1) -> FloatArray:
        policy.seed_noise(seed)
        settings = ExecutionSettings(name="toge", num_diffusion_steps=steps)
        return chunks_of_samples(make_openvino_runner(policy, settings, "f32", "f32"), samples)

    first = chunks()
    assert len(cached(tmp_path)) == 2
    np.testing.assert_array_equal(chunks(), first)
    assert not np.array_equal(chunks(seed=1), first)  # the noise is not part of the graphs
    assert len(cached(tmp_path)) == 2
    for path in cached(tmp_path):
        path.write_bytes(path.read_bytes()[:1000])
    np.testing.assert_array_equal(chunks(), first)
    chunks(steps=2)
    assert len(cached(tmp_path)) == 3
    with torch.no_grad():
        policy.head.unet.out.bias += 0.1
    expected, anew = both(policy, ExecutionSettings(name="toge", num_diffusion_steps=1))
    np.testing.assert_allclose(anew, expected, atol=2e-3)
    assert len(cached(tmp_path)) == 5


def test_openvino_is_kept_from_calling_home() -> None:
    program = (
        "import sys; import policy.engines.openvino_cpu; "
        "sys.exit(sys.modules.get('openvino_telemetry') is not None)"
    )
    assert subprocess.run([sys.executable, "-c", program], timeout=60, check=False).returncode == 0
