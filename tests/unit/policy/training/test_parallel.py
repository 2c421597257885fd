"""A step on two threads is the step on one; images are encoded once, as time permits."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.flight_folders import write_spot_flight
from policy.contract import Contract
from policy.data.flight_folders import read_flight
from policy.data.frames import store_frames
from policy.data.samples import Timeline
from policy.nets.toge import Toge, TogeConfig
from policy.training.batches import (
    ENCODE_BATCH,
    SHARE,
    Batch,
    Batches,
    colour_matrix,
    disturb,
    encode_frames,
)
from policy.training.parallel import Gradients, StepLoss, one_thread
from policy.training.settings import TrainSettings
from policy.training.trainee import Trainee

CONTRACT = Contract(image_height=32, image_width=32, horizon=4, since_exposure=True)
CPU = torch.device("cpu")


@pytest.fixture(params=[1, 2], ids=["one thread", "two threads"])
def threads(request: pytest.FixtureRequest) -> int:
    count: int = request.param
    return count


@pytest.fixture(scope="module")
def batch(tmp_path_factory: pytest.TempPathFactory) -> Batch:
    folder = tmp_path_factory.mktemp("flight")
    flight = read_flight(write_spot_flight(folder / "flight", 0, seconds=0.6))
    store = store_frames([flight], folder / "frames", 32)
    settings = TrainSettings(out=folder / "a.safetensors", image_size=32, batch_size=7, repeats=3)
    ages_ns = np.array([20_000_000], np.int64)
    batches = Batches(
        Timeline([flight], CONTRACT, ages_ns), store, timesteps=100, settings=settings
    )
    return batches.with_images(0)


def trainee() -> Trainee:
    torch.manual_seed(0)
    return Trainee(Toge(TogeConfig(backbone="resnet8", contract=CONTRACT)), gate_weight=1.0)


def losses(model: Trainee, batch: Batch) -> StepLoss:
    loss: StepLoss = model(batch)
    return loss


def gradients_of(
    batch: Batch, model: Trainee, threads: int, *, with_norms: bool
) -> dict[str, torch.Tensor]:
    with Gradients(model, device=CPU, bf16=False, threads=threads) as gradients:
        for replica in gradients.replicas:
            replica.train()
            replica.policy.backbone.train(with_norms)  # batch norms would see other batches
        assert gradients.compute(batch, losses)["loss"].isfinite()
    return {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}


def test_gradients_are_those_of_the_mean_loss(batch: Batch, threads: int) -> None:
    model = trainee()
    made = gradients_of(batch, model, threads, with_norms=False)
    model.zero_grad()
    parts = batch.split(threads)
    for part in parts:
        (losses(model, part).total / len(parts)).backward()  # type: ignore[no-untyped-call]
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None
        torch.testing.assert_close(parameter.grad, made[name], rtol=1e-3, atol=1e-6)


def test_statistics_of_norms_are_those_of_the_first_part(batch: Batch, threads: int) -> None:
    model, alone = trainee(), trainee().train()
    gradients_of(batch, model, threads, with_norms=True)
    alone(batch.split(threads)[0])
    after, expected = (m.policy.backbone.bn1.running_mean for m in (model, alone))  # type: ignore[union-attr]
    assert after.any()
    torch.testing.assert_close(after, expected)


def test_one_thread_is_left_as_it_was() -> None:
    torch.set_num_threads(2)  # every test starts with one, and ends so
    try:
        with one_thread() as before:
            assert (before, torch.get_num_threads()) == (2, 1)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)


def test_images_are_encoded_both_ways(tmp_path: Path) -> None:
    frames = np.arange(3, 2 * ENCODE_BATCH + 10, 2)

    def encode(part: np.ndarray, is_mirrored: bool) -> torch.Tensor:
        """Outputs that tell their image; negative where it was mirrored."""
        return (-1.0 if is_mirrored else 1.0) * torch.from_numpy(part).float()[:, None].expand(
            -1, 2
        )

    done: list[float] = []
    store = encode_frames(tmp_path / "all", frames, encode, mirror=True, progress=done.append)
    is_mirrored = np.arange(len(frames)) % 3 == 0
    read = store.read(frames[::-1], is_mirrored)
    np.testing.assert_array_equal(read[:, 1], np.where(is_mirrored, -1.0, 1.0) * frames[::-1])
    assert done == sorted(done)


def test_images_are_disturbed_and_as_many_left_alone_as_the_shares_say() -> None:
    images = np.full((800, 48, 64, 3), 128, np.uint8)
    disturb(images, np.random.default_rng(0))
    same = (images == 128).all(axis=(1, 2, 3)).mean()
    assert abs(same - (1 - SHARE) ** 3) < 0.06  # new colours leave grey as it is
    means = images.mean(axis=(1, 2, 3))
    assert means.min() < 45
    assert means.max() > 200
    coloured = np.ptp(images, axis=3).max(axis=(1, 2)) > 0
    assert 0.15 < coloured.mean() < 0.35
    assert (images[~coloured].std(axis=(1, 2)).max(axis=1) > 20).any()


def test_colours_turn_about_grey() -> None:
    rgb = np.array([200.0, 40.0, 60.0])
    same, green, grey = (colour_matrix(*how) @ rgb for how in ((0, 1), (math.tau / 3, 1), (1, 0)))
    np.testing.assert_allclose(same, rgb)
    np.testing.assert_allclose(green, rgb[[2, 0, 1]])
    np.testing.assert_allclose(grey, 100.0)
