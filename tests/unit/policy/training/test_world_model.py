"""Training a world model on flights whose sticks steer what is seen."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.steered_flights import steered_flight
from helpers.training_runs import SMALL_WORLD, card_of, make_hooks, weights_of
from policy.data.flight_data import FlightData
from policy.data.windows import find_windows
from policy.errors import PolicyError
from policy.nets.world_model.config import WorldModelConfig
from policy.nets.world_model.model import WorldModel
from policy.nets.world_model.motion import motion_since
from policy.training.batches import FeatureStore
from policy.training.report import TrainingProgress, TrainResult
from policy.training.settings import WorldModelSettings
from policy.training.world_model_losses import (
    CONTEXT_NOISE,
    WindowBatches,
    dynamics_loss,
    set_scales,
)
from policy.training.world_model_run import train_world_model

pytestmark = pytest.mark.usefixtures("one_thread")

WIDER = replace(SMALL_WORLD, autoencoder_widths=(16, 16, 16), dynamics_width=64)


@pytest.fixture(scope="module")
def flights() -> list[FlightData]:
    """Short ones, to run through."""
    return [steered_flight(seed, seconds=1.0) for seed in range(3)]


def settings(out: Path, **changes: object) -> WorldModelSettings:
    made = WorldModelSettings(
        out=out / "world.safetensors",
        image_size=32,
        steps=6,
        batch_size=8,
        window_batch_size=8,
        autoencoder_share=0.5,
        ema_decay=0.95,
        precision="f32",
        mirror=False,
        validations=3,
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def run(
    flights: list[FlightData],
    settings: WorldModelSettings,
    report: Callable[[TrainingProgress], None] = lambda _: None,
    model: WorldModelConfig = SMALL_WORLD,
) -> TrainResult:
    return train_world_model(flights, model, settings, make_hooks(report))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[TrainResult, WorldModelSettings]:
    """A few seconds of training on flights of three seconds."""
    made = settings(
        tmp_path_factory.mktemp("trained"),
        steps=120,
        batch_size=16,
        window_batch_size=16,
        learning_rate=4e-3,
        ema_decay=0.9,
        validations=2,
    )
    return run([steered_flight(seed) for seed in range(6)], made, model=WIDER), made


def test_sticks_tell_how_the_vehicle_will_move(trained):
    result, made = trained
    held_out = result.validation
    assert held_out.velocity_error_mps < 0.5 * held_out.held_velocity_error_mps
    log = [json.loads(line) for line in (made.work_folder / "log.jsonl").read_text().splitlines()]
    for stage in ("autoencoder", "dynamics"):
        losses = [line["loss"] for line in log if line["stage"] == stage and "loss" in line]
        assert losses[-1] < 0.7 * losses[0]
    assert {"latents", "motion", "sticks", "learning_rate"} <= set(log[-2])
    predicted = [line["motion_prediction"] for line in log if "motion_prediction" in line]
    assert predicted[-1] < 0.8 * predicted[0]
    assert [path.name for path in made.work_folder.iterdir()] == ["log.jsonl"]


def test_a_checkpoint_says_how_it_was_trained(trained):
    card = card_of(trained[0].checkpoint)
    assert card["flights"] == 5
    assert card["images"] == 5 * 91
    assert card["windows"] == 5 * 76
    assert 60 < card["steps"] <= 120
    assert card["validation"]["psnr_db"] > 10


def test_an_autoencoder_that_is_kept_stays_as_it_is(flights, tmp_path):
    whole = run(flights, settings(tmp_path))
    (tmp_path / "next").mkdir()
    stages: set[str] = set()
    made = settings(tmp_path / "next", start_from=whole.checkpoint)
    result = run(flights, made, lambda progress: stages.add(progress.stage))
    assert result.steps == 6
    assert "dynamics" in stages
    assert "autoencoder" not in stages
    before, after = (weights_of(path) for path in (whole.checkpoint, result.checkpoint))
    kept = [name for name in before if name.startswith(("autoencoder.enc", "autoencoder.dec"))]
    assert kept
    assert all(before[name] == after[name] for name in kept)
    assert any(before[name] != after[name] for name in before if name.startswith("dynamics"))
    with pytest.raises(PolicyError, match="latent_channels 4, this model 8"):
        run(flights, made, model=replace(SMALL_WORLD, latent_channels=8))


def latents_of(windows_frames: int) -> FeatureStore:
    """Latents that tell their frame, and whether it was mirrored."""
    frames = np.arange(windows_frames)
    plain = np.broadcast_to(frames[:, None], (windows_frames, 64))
    return FeatureStore(np.stack([plain, -plain]).astype(np.float16), frames)


def test_batches_follow_from_seed_and_step_and_mirror_all_that_a_mirror_shows(tmp_path):
    windows = find_windows([steered_flight(0)], context_frames=2, frames=4, frame_dt_s=0.1)
    latents = latents_of(91)
    asked = settings(tmp_path, seed=3, mirror=True, decision_share=0.25, window_batch_size=64)
    batches = WindowBatches(windows, latents, SMALL_WORLD, asked)
    batch = batches.batch(5)
    for name, value in vars(batches.batch(5)).items():
        assert torch.equal(value, getattr(batch, name)), name
    assert not torch.equal(batches.batch(6).latents, batch.latents)
    is_mirrored = batch.latents[:, -1, 0, 0, 0] < 0
    assert 0.3 < is_mirrored.float().mean() < 0.7
    assert 0.1 < (~batch.knows_actions).float().mean() < 0.4
    assert batch.context_noise.std() < CONTEXT_NOISE
    first = batch.latents[:, 0, 0, 0, 0].abs().long()
    plain = windows.at(np.searchsorted(windows.frames[:, 0], first.numpy()))
    states = torch.from_numpy(plain.states[plain.frames])
    signs = torch.where(is_mirrored, -1.0, 1.0)
    yaw = torch.from_numpy(plain.actions[..., 1]) * signs[:, None]
    torch.testing.assert_close(batch.actions[..., 1], yaw)
    torch.testing.assert_close(batch.states[..., 9], states[..., 9] * signs[:, None])
    # The mirrored state is one that could be flown: its turn fits its rates.
    turned = _turn_about_z(batch.states)
    flown = _turn_about_z(states)
    torch.testing.assert_close(turned, flown * signs[:, None], atol=1e-4, rtol=0)
    for part in batches.validation(16):
        assert (part.context_noise == 0).all()
        assert (part.latents >= 0).all()
        assert abs(part.knows_actions.float().mean() - 0.5) < 0.05


def _turn_about_z(states: torch.Tensor) -> torch.Tensor:
    """Since the last state of the context, rad."""
    motion = motion_since(states[:, 1:2], states[:, 2:])
    return torch.atan2(motion[..., 4], 1 + motion[..., 3])


def test_known_sticks_are_no_loss(tmp_path: Path) -> None:
    windows = find_windows([steered_flight(0)], context_frames=2, frames=4, frame_dt_s=0.1)
    latents = latents_of(91)
    model = WorldModel(SMALL_WORLD)
    for share, decides in ((0.0, False), (1.0, True)):
        batches = WindowBatches(
            windows, latents, SMALL_WORLD, settings(tmp_path, decision_share=share)
        )
        with torch.inference_mode():
            metrics = dynamics_loss(model, batches.batch(0)).metrics
        assert (float(metrics["sticks"]) > 0) == decides
        assert float(metrics["motion"]) > 0
        assert float(metrics["latents"]) > 0


def test_scales_are_stored_on_the_device_of_the_model(tmp_path: Path) -> None:
    """Torch's meta device refuses tensors of another device, as a GPU does."""
    windows = find_windows([steered_flight(0)], context_frames=2, frames=4, frame_dt_s=0.1)
    latents = latents_of(91)
    model = WorldModel(SMALL_WORLD).to("meta")
    set_scales(model, windows, latents, mirrors=True)
    assert model.change_std.is_meta
