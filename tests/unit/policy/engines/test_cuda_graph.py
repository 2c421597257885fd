"""The CUDA graph engine against plain torch on the CPU; needs a GPU."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from policy.contract import Contract, FloatArray
from policy.engines.choose import (
    choose_runner,
    chunks_of_samples,
    make_parity_samples,
    parity_failure,
)
from policy.engines.runner import ExecutionSettings
from policy.engines.torch_engines import make_cuda_graph_runner, make_torch_runner
from policy.nets.toge import Toge, TogeConfig

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU"),
]

SMALL = Contract(image_height=64, image_width=64)
ON_GPU = ExecutionSettings(name="toge", device="cuda")


@pytest.mark.parametrize("size", ["shipped", "large"])
def test_the_graph_computes_what_torch_computes(trained_toge: Toge, size: str) -> None:
    torch.manual_seed(0)
    large = TogeConfig(size="large", contract=SMALL)
    policy = trained_toge if size == "shipped" else Toge(large).eval()
    samples, plain = make_parity_samples(policy.contract), ExecutionSettings(name="t")
    expected = chunks_of_samples(make_torch_runner(policy, plain), samples)
    chunks = chunks_of_samples(make_cuda_graph_runner(policy, ON_GPU), samples)
    assert parity_failure(expected, chunks) is None


def test_the_default_on_a_gpu_is_the_graph(small_toge: Toge) -> None:
    runner, notes = choose_runner(small_toge, "auto", ON_GPU)
    assert runner.engine == "cuda-graph", notes


def test_both_paths_at_once_do_not_touch_each_other(small_toge: Toge) -> None:
    runner, samples = make_cuda_graph_runner(small_toge, ON_GPU), make_parity_samples(SMALL)
    rgb = samples.rgb[:, :32, :32]
    features = [runner.encode(image) for image in rgb]
    state, history = samples.state[:1], samples.history[:1]
    chunk = runner.act(features[0], state, history)

    def encode_all() -> list[FloatArray]:
        return [runner.encode(rgb[index % len(rgb)]) for index in range(100)]

    with ThreadPoolExecutor(1) as vision:
        pending = vision.submit(encode_all)
        for _ in range(100):
            np.testing.assert_array_equal(runner.act(features[0], state, history), chunk)
        for index, feature in enumerate(pending.result(60)):
            np.testing.assert_array_equal(feature, features[index % len(rgb)])
