"""Training on flights in which the image alone says what to do."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.flight_folders import MS, spot, ticks_table, write_flight, write_spot_flight
from helpers.training_runs import card_of, make_hooks, weights_of
from policy.checkpoints.networks import load_checkpoint, save_checkpoint
from policy.contract import Contract
from policy.data.flight_data import FlightData, hold_out
from policy.data.flight_folders import read_flight
from policy.data.frames import store_frames
from policy.data.samples import Timeline
from policy.errors import DatasetError, PolicyError
from policy.nets.toge import Toge, TogeConfig
from policy.training import batches as batches_module
from policy.training.batches import SHARE, Batches, colour_matrix, disturb
from policy.training.policy_run import train_policy
from policy.training.report import TrainingProgress, TrainResult
from policy.training.run import TrainingError, TrainingStoppedError
from policy.training.settings import TrainSettings
from policy.training.trainee import Trainee, gate_labels, gate_loss

pytestmark = pytest.mark.usefixtures("one_thread")

CONTRACT = Contract(image_height=32, image_width=32, horizon=4, since_exposure=True)
NETWORK = TogeConfig(backbone="resnet8", contract=CONTRACT)


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> list[FlightData]:
    """Short ones, to run through."""
    folder = tmp_path_factory.mktemp("flights")
    return [read_flight(write_spot_flight(folder / str(n), n, seconds=0.6)) for n in range(3)]


def settings(out: Path, **changes: object) -> TrainSettings:
    made = TrainSettings(
        out=out / "trained.safetensors",
        image_size=32,
        steps=4,
        batch_size=8,
        repeats=2,
        head_batch_size=32,
        ema_decay=0.95,
        precision="f32",
        validations=2,
        gate_weight=0.2,  # of so few steps the sticks need most
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def run(
    flights: list[FlightData],
    settings: TrainSettings,
    report: Callable[[TrainingProgress], None] = lambda _: None,
    network: TogeConfig = NETWORK,
) -> TrainResult:
    return train_policy(flights, network, settings, make_hooks(report))


def noted(flights: list[FlightData], settings: TrainSettings) -> tuple[TrainResult, str]:
    """Return the result and the notes of a run."""
    notes: list[str] = []
    result = run(flights, settings, lambda progress: notes.append(progress.note or ""))
    return result, "\n".join(notes)


def test_learns_where_the_image_says_to_go(tmp_path: Path) -> None:
    flights = [read_flight(write_spot_flight(tmp_path / str(n), n)) for n in range(4)]
    asked = settings(tmp_path, steps=90, batch_size=16, disturb=False)
    result = run(flights, asked)
    held_out = result.validation
    assert held_out.stick_error < 0.6 * held_out.mean_stick_error
    assert held_out.stick_error < 0.6 * held_out.hold_error
    policy = load_checkpoint(result.checkpoint, fallback=NETWORK)
    assert policy.contract == replace(CONTRACT, feature_dim=256)
    card = card_of(result.checkpoint)
    assert (card["flights"], card["batch_size"]) == (3, 16)
    low_ms, high_ms = card["feature_ages_ms"]
    assert 40 <= low_ms < high_ms <= 75
    log = asked.work_folder / "log.jsonl"
    first = json.loads(log.read_text().splitlines()[0])
    assert {"loss", "gate_loss", "learning_rate", "stage", "fraction"} <= set(first)
    assert list(asked.work_folder.iterdir()) == [log]


def test_equal_runs_give_equal_weights_and_a_stopped_run_keeps_its_best(flights, tmp_path):
    asked = settings(tmp_path)
    first = weights_of(run(flights, asked).checkpoint)
    asked.out.unlink()
    assert weights_of(run(flights, asked).checkpoint) == first
    validated: list[TrainingProgress] = []
    hooks = make_hooks(
        lambda progress: validated.append(progress) if progress.validation else None,
        should_stop=lambda: bool(validated),
    )
    with pytest.raises(TrainingStoppedError, match=r"trained\.safetensors holds the best weights"):
        train_policy(flights, NETWORK, asked, hooks)
    load_checkpoint(asked.out, fallback=NETWORK)
    assert [path.name for path in asked.work_folder.iterdir()] == ["log.jsonl"]


def test_a_run_stopped_before_its_first_validation_overwrites_nothing(flights, tmp_path):
    asked = settings(tmp_path)
    asked.out.write_bytes(b"of an earlier run")
    with pytest.raises(TrainingStoppedError, match="nothing is kept"):
        train_policy(flights, NETWORK, asked, make_hooks(should_stop=asked.work_folder.exists))
    assert asked.out.read_bytes() == b"of an earlier run"


def test_a_flight_of_no_use_is_left_out_whether_or_not_it_would_be_held_out(flights, tmp_path):
    asked = settings(tmp_path, steps=2, validations=1)
    held = hold_out(flights, asked.validation_fraction, asked.seed)[1][0]
    blind = replace(flights[held], name="blind", captured_ns=flights[held].captured_ns - 10**10)
    mixed = [*flights[:held], blind, *flights[held + 1 :]]
    result, notes = noted(mixed, asked)
    assert result.validation is not None
    assert "left out: blind: none of 18 images" in notes
    with pytest.raises(DatasetError, match="blind: none of 18 images"):
        run([blind], asked)


def test_ages_of_a_camera_that_paused_are_not_learned(flights, tmp_path):
    """Measured on this computer, where the camera stopped for seconds: nothing flies by those."""
    woke = [10**9 + 10 * MS * k for k in range(600)]
    seen = [woke[k] - 40 * MS if k < 100 else woke[99] for k in range(600)]
    table = ticks_table(woke_ns=woke, expert=None, sent=[None] * 600, captured_ns=seen)
    measured = write_flight(tmp_path / "ages", table, captured_ns=[10**9], images=[spot(32, 0.0)])
    asked = settings(tmp_path, steps=1, validations=1, ages=str(measured))
    run(flights, asked)
    assert card_of(asked.out)["feature_ages_ms"] == [10.0, 1000.0]
    table = ticks_table(woke_ns=woke, expert=None, sent=[None] * 600, captured_ns=[-(10**9)] * 600)
    write_flight(tmp_path / "old", table, captured_ns=[10**9], images=[spot(32, 0.0)])
    with pytest.raises(DatasetError, match="each image in it was over 1000 ms old"):
        run(flights, replace(asked, ages=str(tmp_path / "old")))


def test_images_of_several_proportions_are_told(flights, tmp_path):
    wide = np.zeros((18, 32, 3), np.uint8)
    other = replace(flights[0], decode=lambda: (wide for _ in flights[0].captured_ns))
    asked = settings(tmp_path, steps=1, validations=1)
    assert "(width by height 1, 1.78)" in noted([other, flights[1]], asked)[1]
    assert "width by height" not in noted([other], asked)[1]


def test_it_trains_without_gates_and_packed(flights, tmp_path):
    changes = {"gate_weight": 0.0, "mirror": False, "validations": 1, "steps": 2, "pack": True}
    result = run(flights[:2], settings(tmp_path, **changes))
    assert load_checkpoint(result.checkpoint, fallback=NETWORK).contract.horizon == CONTRACT.horizon
    weights = sum(p.numel() for p in Toge(NETWORK).parameters())
    assert result.checkpoint.stat().st_size < 2 * weights


def test_by_rates_no_error_of_a_held_stick_is_told(flights, tmp_path):
    by_rates = replace(NETWORK, contract=replace(CONTRACT, action="rates", modes=()))
    held_out = run(flights, settings(tmp_path, validations=1), network=by_rates).validation
    assert held_out.hold_error is None
    assert "held)" not in held_out.describe()
    assert "(mean stick" in held_out.describe()


LOITERED: tuple[dict[str, Any], str] = ({"modes": ("LOITER",)}, "sticks in LOITER")


def test_a_training_goes_on_from_a_checkpoint_and_keeps_its_terms(flights, tmp_path):
    terms = {"modes": ("ALT_HOLD",), "max_chunk_age_s": 1.0, "max_stall_s": 0.35, "play_s": 0.1}
    start = Toge(replace(NETWORK, contract=replace(CONTRACT, **terms)))
    path = tmp_path / "start.safetensors"
    save_checkpoint(path, start)
    further = settings(tmp_path, start_from=path, learning_rate=0.0, validation_fraction=0.0)
    result = run(flights[:2], further)
    assert result.validation is None
    before, after = weights_of(path), weights_of(result.checkpoint)
    assert "head.unet.out.weight" in [name for name in before if before[name] == after[name]]
    trained = load_checkpoint(result.checkpoint, fallback=NETWORK).contract
    assert terms == {name: getattr(trained, name) for name in terms}
    other = TogeConfig(backbone="resnet50", contract=CONTRACT)
    refused = replace(further, out=tmp_path / "refused.safetensors")
    with pytest.raises(PolicyError, match=r"another policy: backbone 'resnet8'"):
        run(flights[:2], refused, network=other)
    assert not refused.work_folder.exists()
    for changes, told in (({"action": "rates", "modes": ()}, "rates in GUIDED"), LOITERED):
        network = replace(NETWORK, contract=replace(CONTRACT, **changes))
        with pytest.raises(PolicyError, match=f"flies by sticks in ALT_HOLD, .* by {told}"):
            run(flights[:2], further, network=network)


def test_only_the_end_is_learned_and_the_gates_are_flown_as_before(flights, tmp_path):
    start = tmp_path / "start.safetensors"
    save_checkpoint(start, Toge(NETWORK))
    ended = replace(flights[0], gate=np.full_like(flights[0].gate, np.nan))
    asked = settings(
        tmp_path, start_from=start, only_end=True, steps=40, learning_rate=3e-3, mirror=False
    )

    def errors(path: Path) -> tuple[float, float]:
        """Return the distance of the chunks from the start's and from the pilot's."""
        policy, before = (load_checkpoint(each, fallback=NETWORK) for each in (path, start))
        images, _ = store_frames(flights[:1], path.with_suffix(".frames"), 32)
        timeline = Timeline(flights[:1], CONTRACT, np.array([40_000_000]))
        batches = Batches(timeline, timeline.frames, images, timesteps=100, settings=asked)
        batch = next(batches.validation(timeline.frames, 64))
        trainee = Trainee(policy, 0.0)
        chunk = trainee.teach(batch).chunk
        return (
            (chunk - Trainee(before, 0.0).teach(batch).chunk).abs().mean().item(),
            (chunk - batch.chunk).abs().mean().item(),
        )

    run([ended] * 3, asked)
    changed, error = errors(asked.out)
    run(flights, asked)
    kept, _ = errors(asked.out)
    assert kept < 0.2 * changed
    assert error < 0.6 * errors(start)[1]
    before, after = weights_of(start), weights_of(asked.out)
    same = {name for name in before if before[name] == after[name]}
    assert {name for name in before if name.startswith("backbone.")} <= same
    with pytest.raises(PolicyError, match="needs --start-from"):
        replace(asked, start_from=None)


def test_images_are_disturbed_in_training_and_never_in_validation(flights, tmp_path, monkeypatch):
    monkeypatch.setattr(batches_module, "disturb", lambda images, _random: images.fill(255))
    images, _ = store_frames(flights, tmp_path / "frames", 32)
    timeline = Timeline(flights, CONTRACT, np.array([40_000_000]))
    batches = Batches(timeline, timeline.frames, images, timesteps=100, settings=settings(tmp_path))
    assert (batches.with_images(0).images == 255).all()
    assert not (next(batches.validation(timeline.frames, 4)).images == 255).all()


def test_a_budget_of_time_ends_and_has_time_for_the_head(flights, tmp_path):
    stages: list[str] = []
    result = run(
        flights[:2],
        settings(tmp_path, steps=None, minutes=4 / 60, validations=1),
        lambda progress: stages.append(progress.stage),
    )
    assert 0 < result.steps < 200
    assert "head" in stages


def test_weights_that_were_never_trained_are_not_kept(flights, tmp_path):
    asked = settings(tmp_path, steps=None, minutes=0.01)
    with pytest.raises(TrainingError, match="before the first step"):
        train_policy(flights[:2], NETWORK, asked, replace(make_hooks(), now_s=count().__next__))
    assert not asked.out.exists()


def test_weights_that_diverge_are_refused(flights, tmp_path):
    with pytest.raises(TrainingError, match="diverged"):
        run(flights[:2], settings(tmp_path, steps=44, learning_rate=1e30))


def test_gate_labels_leave_out_what_no_camera_sees() -> None:
    ahead = [3.0, 0.0, 4.0, 0.5, 0.0, 5.0, 0.0]  # 5 m away; the gate after it is abeam
    behind = [-3.0, 0.0, 4.0, 0.5, *[float("nan")] * 3]
    labels = gate_labels(torch.tensor([ahead, behind]))
    expected = [0.6, 0.0, 0.8, np.log(0.5), np.cos(0.5), np.sin(0.5)]
    np.testing.assert_allclose(labels[0, :6].numpy(), expected, atol=1e-6)
    assert labels[0, 6:].isnan().all()
    assert labels[1].isnan().all()
    made = torch.zeros(2, 10, requires_grad=True)
    gate_loss(made, torch.tensor([ahead, behind])).backward()  # type: ignore[no-untyped-call]
    assert made.grad.isfinite().all()
    assert not made.grad[1].any()


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
