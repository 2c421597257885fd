"""The OpenVINO engine against plain torch, on a CPU; every graph is compiled once per test run."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.programs import ended
from policy.contract import Contract, FloatArray
from policy.engines import openvino_compile
from policy.engines.choose import chunks_of_samples, make_parity_samples
from policy.engines.openvino_compile import (
    MAX_BYTES,
    MAX_ENTRIES,
    load_blob,
    precisions,
    store_blob,
    user_cache_folder,
)
from policy.engines.openvino_modules import MAX_UNROLLED, ModuleConverter, make_module_runner
from policy.engines.runner import ExecutionSettings, Precision
from policy.engines.torch_engines import make_torch_runner
from policy.errors import PolicyError
from policy.nets.diffusion import NoiseSchedule
from policy.nets.toge import Toge, TogeConfig
from policy.protocol import PolicyRunner

SMALL = Contract(image_height=32, image_width=32)
SETTINGS = ExecutionSettings(name="toge", num_diffusion_steps=2)


def seeded(config: TogeConfig) -> Toge:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        policy = Toge(config).eval()
    policy.head.seed_noise(3)
    return policy


def converted(
    policy: Toge,
    settings: ExecutionSettings,
    vision: Precision = "f32",
    action: Precision = "f32",
) -> PolicyRunner:
    converter = ModuleConverter(policy, settings)
    return make_module_runner(converter, policy, settings, vision, action)


def both(policy: Toge, settings: ExecutionSettings) -> tuple[FloatArray, FloatArray]:
    """Chunks by plain torch, and by OpenVINO in float32."""
    samples = make_parity_samples(policy.contract)
    reference = make_torch_runner(policy, settings)
    runner = converted(policy, settings)
    assert runner.engine == "openvino-f32"
    return chunks_of_samples(reference, samples), chunks_of_samples(runner, samples)


OTHER = TogeConfig(
    backbone="resnet18",
    contract=Contract(image_height=32, image_width=48, horizon=8, history_len=2),
    schedule=NoiseSchedule(betas="linear", num_train_timesteps=50),
)


@pytest.mark.parametrize(
    ("config", "steps"),
    [
        (TogeConfig(backbone="resnet18", contract=replace(SMALL, since_exposure=True)), 1),
        (OTHER, MAX_UNROLLED + 1),
    ],
)
def test_single_rate_computes_what_torch_computes(config: TogeConfig, steps: int) -> None:
    settings = ExecutionSettings(name="toge", num_diffusion_steps=steps, dual_rate=False)
    expected, chunks = both(seeded(config), settings)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(chunks, expected, atol=2e-3)


def test_every_precision_of_this_cpu_is_near_and_results_belong_to_the_caller(trained_toge):
    samples = make_parity_samples(trained_toge.contract)
    expected = chunks_of_samples(make_torch_runner(trained_toge, SETTINGS), samples)
    for vision, action in precisions():
        runner = converted(trained_toge, SETTINGS, vision, action)
        assert runner.engine.startswith(f"openvino-{vision}")
        # Three significant digits of bfloat16; whether that is near enough the check decides.
        assert np.abs(chunks_of_samples(runner, samples) - expected).max() < 0.05
    first = runner.encode(samples.rgb[0])
    kept = first.copy()
    assert not np.array_equal(runner.encode(samples.rgb[1]), first)
    np.testing.assert_array_equal(first, kept)
    with pytest.raises(PolicyError, match=r"input 0 must be \[1, 256\], got \[1, 1\]"):
        runner.act(np.zeros((1, 1), np.float32), samples.state[:1], samples.history[:1])


def cached(folder: Path) -> list[Path]:
    return sorted((folder / "mavbridge" / "openvino").glob("*.graph"))


def test_compiled_graphs_are_cached_and_damage_does_no_harm(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    policy = seeded(TogeConfig(backbone="resnet8", contract=SMALL))
    samples = make_parity_samples(SMALL)

    def chunks(seed: int = 0) -> FloatArray:
        policy.head.seed_noise(seed)
        settings = ExecutionSettings(name="toge", num_diffusion_steps=1)
        return chunks_of_samples(converted(policy, settings), samples)

    first = chunks()
    assert len(cached(tmp_path)) == 2
    assert not np.array_equal(chunks(seed=1), first)  # the noise is part of the graphs
    for path in cached(tmp_path):
        path.write_bytes(path.read_bytes()[:1000])
    np.testing.assert_array_equal(chunks(), first)
    with torch.no_grad():
        policy.head.unet.out.bias += 0.1
    expected, anew = both(policy, ExecutionSettings(name="toge", num_diffusion_steps=1))
    np.testing.assert_allclose(anew, expected, atol=2e-3)
    assert len(cached(tmp_path)) == 6


SIGNALS = """
import gc, os, signal, sys
from policy.loading.request import PolicyRequest
from policy.loading.load import load_policy

request = PolicyRequest(
    spec="toge:small:resnet8", allow_untrained=True, engine="openvino", num_diffusion_steps=1,
    image_size=32,
)
loaded = load_policy(request, now_s=lambda: 0.0)
heard = []
signal.signal(signal.SIGINT, lambda *_: heard.append("in flight"))
os.kill(os.getpid(), signal.SIGINT)
del loaded
gc.collect()
signal.signal(signal.SIGINT, lambda *_: heard.append("after it"))
os.kill(os.getpid(), signal.SIGINT)
print(heard, sys.modules["openvino_telemetry"])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the alternate signal stack is kept on Linux")
def test_a_signal_is_heard_whatever_has_become_of_the_engine_which_does_not_call_home() -> None:
    ran = ended(sys.executable, "-c", SIGNALS)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip() == "['in flight', 'after it'] None"


BLOB = b"a compiled graph" * 100


def test_keeps_what_was_stored_until_it_is_damaged(tmp_path: Path) -> None:
    path, other = (tmp_path / "new" / "folder" / f"{name}.graph" for name in "ab")
    assert load_blob(path) is None
    store_blob(path, BLOB)
    store_blob(other, b"")
    assert (load_blob(path), load_blob(other)) == (BLOB, b"")
    whole = path.read_bytes()
    flipped = [whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :] for at in (0, 31, 32, 500)]
    for damaged in (*(whole[:kept] for kept in (0, 1, 31, 32, 33, len(whole) - 1)), *flipped):
        path.write_bytes(damaged)
        assert load_blob(path) is None
    store_blob(path, b"newer")
    assert load_blob(path) == b"newer"


@pytest.mark.parametrize(
    ("most_bytes", "kept"),
    [(3 * len(BLOB), {0, 5}), (MAX_BYTES, {0, *range(2, MAX_ENTRIES + 1)})],
)
def test_the_least_recently_used_goes_first(tmp_path, monkeypatch, most_bytes, kept):
    count = 5 if most_bytes < MAX_BYTES else MAX_ENTRIES
    paths = [tmp_path / f"{index}.graph" for index in range(count + 1)]
    for index, path in enumerate(paths[:count]):  # each a second after the one before
        store_blob(path, BLOB)
        os.utime(path, (index, index))
    assert load_blob(paths[0]) == BLOB  # used: now the newest
    monkeypatch.setattr(openvino_compile, "MAX_BYTES", most_bytes)
    store_blob(paths[count], BLOB)
    assert {n for n, path in enumerate(paths) if load_blob(path) is not None} == kept


def test_a_folder_that_cannot_be_used_means_no_cache(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    path = tmp_path / "file" / "below" / "a.graph"
    store_blob(path, BLOB)
    assert load_blob(path) is None


def test_the_folder_is_where_xdg_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for xdg, root in (("/somewhere", Path("/somewhere")), ("relative", tmp_path / ".cache")):
        monkeypatch.setenv("XDG_CACHE_HOME", xdg)
        assert user_cache_folder() == root / "mavbridge"
