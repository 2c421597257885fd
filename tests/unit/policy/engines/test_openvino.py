"""The OpenVINO engine against plain torch, on a CPU."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from policy.checkpoints.policy_file import BuiltinConfig, BuiltinPolicy, build_policy
from policy.contract import Contract, Executable, FloatArray
from policy.engines.choose import probe_chunks
from policy.engines.executable import Settings
from policy.engines.openvino_cpu import make_openvino_executable, precisions
from policy.engines.openvino_graph import denoise_graph
from policy.engines.openvino_layers import layer
from policy.engines.parity import make_probe
from policy.engines.signal_stack import signal_stack_kept
from policy.engines.torch_eager import make_torch_executable
from policy.errors import PolicyError
from policy.nets.action_head import Size
from policy.nets.backbones import BACKBONE_NAMES, BackboneName
from policy.nets.diffusion import NoiseSchedule, Prediction
from policy.nets.resnet_unet import ResnetUnetConfig
from policy.nets.toge import Toge, TogeConfig

Fly = Callable[[Executable, float | None], FloatArray]
SMALL = Contract(image_height=64, image_width=64)


def seeded(config: BuiltinConfig) -> BuiltinPolicy:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        policy = build_policy(config).eval()
    policy.reset(3)
    return policy


def both(policy: BuiltinPolicy, settings: Settings) -> tuple[FloatArray, FloatArray]:
    """Chunks by plain torch, and by OpenVINO in float32."""
    probe = make_probe(policy.contract)
    reference = make_torch_executable(policy, settings)
    executable = make_openvino_executable(policy, settings, "f32", "f32")
    assert executable.engine == "openvino-f32"
    return probe_chunks(reference, probe), probe_chunks(executable, probe)


@pytest.mark.parametrize(
    ("size", "backbone"),
    [*(("small", name) for name in BACKBONE_NAMES), ("medium", "resnet18"), ("large", "resnet18")],
)
def test_toge_computes_what_torch_computes(size: Size, backbone: BackboneName) -> None:
    policy = seeded(TogeConfig(size=size, backbone=backbone, contract=SMALL))
    expected, chunks = both(policy, Settings(name="toge", num_diffusion_steps=4, head_steps=2))
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(chunks, expected, atol=2e-3)


@pytest.mark.parametrize(
    ("size", "since_exposure"),
    [("small", False), ("small", True), ("medium", False), ("large", False)],
)
def test_resnet_unet_computes_what_torch_computes(size: Size, since_exposure: bool) -> None:
    contract = replace(SMALL, since_exposure=since_exposure)
    policy = seeded(ResnetUnetConfig(size=size, contract=contract))
    settings = Settings(name="resnet-unet", num_diffusion_steps=3, dual_rate=False)
    expected, chunks = both(policy, settings)
    np.testing.assert_allclose(chunks, expected, atol=2e-3)


@pytest.mark.parametrize(
    "changes",
    [
        {"schedule": NoiseSchedule(prediction="epsilon", betas="linear", num_train_timesteps=50)},
        {"contract": Contract(image_height=32, image_width=48, horizon=8, history_len=2)},
        {"contract": replace(SMALL, since_exposure=True)},
    ],
)
@pytest.mark.parametrize("dual_rate", [True, False])
def test_other_schedules_shapes_and_single_rate(changes: dict[str, Any], dual_rate: bool) -> None:
    policy = seeded(TogeConfig(**{"backbone": "resnet18", "contract": SMALL, **changes}))
    settings = Settings(name="toge", num_diffusion_steps=3, dual_rate=dual_rate)
    expected, chunks = both(policy, settings)
    np.testing.assert_allclose(chunks, expected, atol=2e-3)


@pytest.mark.parametrize(("vision", "action"), precisions())
def test_every_precision_of_this_cpu_is_near(trained_toge: Toge, vision: Any, action: Any) -> None:
    settings = Settings(name="toge", head_steps=2)
    probe = make_probe(trained_toge.contract)
    expected = probe_chunks(make_torch_executable(trained_toge, settings), probe)
    executable = make_openvino_executable(trained_toge, settings, vision, action)
    assert executable.engine.startswith(f"openvino-{vision}")
    # Three significant digits of bfloat16; whether that is near enough to fly the gate decides.
    assert np.abs(probe_chunks(executable, probe) - expected).max() < 0.05


@pytest.mark.parametrize("action", sorted({action for _, action in precisions()}))
def test_every_bias_is_added_within_its_convolution(trained_toge: Toge, action: str) -> None:
    """Operators of their own for 220 biases cost an eighth of a chunk's time in bf16."""
    import openvino as ov  # after policy.engines, which keeps it from calling home

    with signal_stack_kept():
        properties = {"INFERENCE_PRECISION_HINT": action}
        compiled = ov.Core().compile_model(denoise_graph(trained_toge, 3), "CPU", properties)
        operators = [op.get_rt_info() for op in compiled.get_runtime_model().get_ops()]
    convolutions = [op for op in operators if op["layerType"].astype(str) == "Convolution"]
    assert len(convolutions) == 3 * 22
    for convolution in convolutions:
        assert "Add" in convolution["originalLayersNames"].astype(str)


@pytest.mark.parametrize("prediction", ["sample", "epsilon"])
@pytest.mark.parametrize("head_steps", [1, 2, 4, 10])  # 4: the first segment is padded
def test_segments_compute_what_a_whole_solve_on_torch_does(
    head_steps: int, prediction: Prediction
) -> None:
    schedule = NoiseSchedule(prediction=prediction)
    policy = seeded(TogeConfig(backbone="resnet18", contract=SMALL, schedule=schedule))
    probe = make_probe(SMALL)
    whole = make_torch_executable(policy, Settings(name="toge"))
    settings = Settings(name="toge", head_steps=head_steps)
    segmented = make_openvino_executable(policy, settings, "f32", "f32")
    for rgb, state, history in zip(probe.rgb, probe.state, probe.history, strict=True):
        inputs = whole.encode(rgb), state[None], history[None]
        expected = whole.act(*inputs, None)
        np.testing.assert_allclose(segmented.act(*inputs, None), expected, atol=2e-3)


def test_a_flight_with_a_spread_solve_is_that_of_torch(trained_toge: Toge, fly: Fly) -> None:
    settings = Settings(name="toge", head_steps=3)
    expected = fly(make_torch_executable(trained_toge, settings), 0.01)
    chunks = fly(make_openvino_executable(trained_toge, settings, "f32", "f32"), 0.01)
    np.testing.assert_allclose(chunks, expected, atol=2e-3)


def test_the_same_flight_gives_the_same_sticks(small_toge: Toge, fly: Fly) -> None:
    settings = Settings(name="toge", num_diffusion_steps=3, head_steps=1)
    vision, action = precisions()[0]
    first, second = (
        fly(make_openvino_executable(small_toge, settings, vision, action), 0.01) for _ in range(2)
    )
    np.testing.assert_array_equal(first, second)


def test_results_belong_to_the_caller(small_toge: Toge) -> None:
    executable = make_openvino_executable(small_toge, Settings(name="toge"), "f32", "f32")
    probe = make_probe(small_toge.contract)
    first = executable.encode(probe.rgb[0])
    kept = first.copy()
    second = executable.encode(probe.rgb[1])
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(first, kept)


def test_refuses_an_array_of_another_shape(small_toge: Toge) -> None:
    executable = make_openvino_executable(small_toge, Settings(name="toge"), "f32", "f32")
    state, history = np.zeros((1, 13), np.float32), np.zeros((1, 4, 4), np.float32)
    with pytest.raises(PolicyError, match=r"input 0 must be \[1, 256\], got \[1, 1\]"):
        executable.act(np.zeros((1, 1), np.float32), state, history, None)


def test_a_layer_without_a_form_is_named() -> None:
    with pytest.raises(TypeError, match="Bilinear has no OpenVINO form"):
        layer(nn.Bilinear(1, 1, 1))
    with pytest.raises(TypeError, match="grouped"):
        layer(nn.Conv2d(4, 4, 1, groups=2))


def cached(folder: Path) -> list[Path]:
    return sorted((folder / "mavbridge" / "openvino").glob("*.graph"))


def test_compiled_graphs_are_cached_and_damage_does_no_harm(
    small_toge: Toge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    probe = make_probe(small_toge.contract)

    def chunks(seed: int = 0, steps: int = 2) -> FloatArray:
        small_toge.reset(seed)
        settings = Settings(name="toge", num_diffusion_steps=steps)
        executable = make_openvino_executable(small_toge, settings, "f32", "f32")
        small_toge.reset(0)
        return probe_chunks(executable, probe)

    first = chunks()
    assert len(cached(tmp_path)) == 2
    np.testing.assert_array_equal(chunks(), first)
    assert not np.array_equal(chunks(seed=1), first)  # the noise is not part of the graphs
    assert len(cached(tmp_path)) == 2
    for path in cached(tmp_path):
        path.write_bytes(path.read_bytes()[:1000])
    np.testing.assert_array_equal(chunks(), first)
    chunks(steps=3)
    assert len(cached(tmp_path)) == 3


def test_other_weights_are_compiled_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    policy = seeded(TogeConfig(backbone="resnet18", contract=SMALL))
    settings = Settings(name="toge", num_diffusion_steps=1)
    make_openvino_executable(policy, settings, "f32", "f32")
    with torch.no_grad():
        policy.head.unet.out.bias += 0.1
    expected, chunks = both(policy, settings)
    np.testing.assert_allclose(chunks, expected, atol=2e-3)
    assert len(cached(tmp_path)) == 4


def test_openvino_is_kept_from_calling_home() -> None:
    program = (
        "import sys; import policy.engines.openvino_cpu; "
        "sys.exit(sys.modules.get('openvino_telemetry') is not None)"
    )
    assert subprocess.run([sys.executable, "-c", program], timeout=60, check=False).returncode == 0
