"""Train a policy from flights: encoder and head, then the head alone on stored features."""

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch

from policy.checkpoints.policy_file import save_checkpoint
from policy.data.flight_data import DatasetError, FlightData, Nanoseconds, common_frame
from policy.data.flight_folders import read_ages
from policy.data.frames import FrameStore
from policy.data.samples import Timeline
from policy.training.batches import Batch, Batches, FeatureStore
from policy.training.encode import Encoder
from policy.training.parallel import StepLoss, computing_in
from policy.training.report import Hooks, PolicyValidation, TrainResult, Validation
from policy.training.run import Run, open_run
from policy.training.run_folder import RunFolder
from policy.training.settings import MAX_AGE_MS, TrainSettings
from policy.training.stages import TrainingStage, policy_stages
from policy.training.start import Network, starting_trainee, training_card
from policy.training.trainee import StickSpread, Trainee, validate

Check: TypeAlias = Callable[[Path], float]
"""Flies a checkpoint in closed loop and returns a score: more is better."""

VALIDATION_SAMPLES = 256
FINE_TUNE_RATE = 1 / 3
"""Learning rate over the usual one, for weights that were trained before."""
NS_PER_MS = 1_000_000
HEAD_RATE = 3
"""Learning rate over the usual one, for the head alone: large batches, no convolutions."""


def train_policy(
    flights: Sequence[FlightData],
    network: Network,
    settings: TrainSettings,
    hooks: Hooks,
    check: Check | None = None,
) -> TrainResult:
    """Train, and write the best weights on held-out flights to ``settings.out``.

    Args:
        flights: what to learn from.
        network: what to train; its contract's ``state_frame`` must be that of the flights.
        settings: how, and how long.
        hooks: clock, progress, and a request to stop.
        check: scores a checkpoint, in place of the validation loss.

    Raises:
        DatasetError: flights that cannot be learned from.
        TrainingError: a run that cannot be resumed or kept, or that diverged.
        TrainingStoppedError: ``hooks.should_stop`` ended it.
        PolicyError: weights to start from that do not fit.
    """
    folder = open_run(settings, network, flights)
    if (frame := common_frame(flights)) != network.contract.state_frame:
        raise DatasetError(
            f"the flights hold {frame} states, the policy takes {network.contract.state_frame}"
        )
    ages_ns = _ages(flights, settings)
    return _PolicyRun(flights, ages_ns, network, settings, folder, hooks, check).finish()


class _PolicyRun(Run[Trainee, Batch]):
    validation_type = PolicyValidation

    def __init__(
        self,
        flights: Sequence[FlightData],
        ages_ns: Nanoseconds,
        network: Network,
        settings: TrainSettings,
        folder: RunFolder,
        hooks: Hooks,
        check: Check | None,
    ) -> None:
        self.settings: TrainSettings = settings
        self._network, self._ages_ns, self._check = network, ages_ns, check
        trainee = starting_trainee(network, settings)
        trainee.to(settings.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        super().__init__(folder, trainee, policy_stages(settings), hooks)
        whole, store, kept, held = self.store_flights(flights, self.stages[-1].image_size)
        self._flights = [whole[index] for index in kept]
        self._batches = self._batches_of(whole, kept, store)
        self._held = self._batches_of(whole, held, store) if held else None
        if not held:
            self.note("no flight is held out: the last weights will be kept, not the best")
        targets = np.concatenate([flight.target for flight in self._flights])
        self._spread = StickSpread.of(targets, self.device)
        self._features: FeatureStore | None = None
        self._held_features: list[Batch] | None = None

    def finish(self) -> TrainResult:
        result = super().finish()
        return result if self._check is None else replace(result, score=self.position.best)

    def learning_rate(self, stage: TrainingStage) -> float:
        if not stage.trains_encoder:
            return HEAD_RATE * self.settings.learning_rate
        return self.settings.learning_rate * (FINE_TUNE_RATE if self.settings.start_from else 1)

    def choose_trainable(self, *, trains_encoder: bool) -> None:
        self.trainee.policy.backbone.requires_grad_(trains_encoder)

    def set_mode(self, trainee: Trainee, stage: TrainingStage) -> None:
        trainee.train()
        trainee.policy.backbone.train(stage.trains_encoder)

    def encode(self, stage: TrainingStage, *, is_new: bool) -> None:
        settings, frames = self.settings, self._batches.frames
        encoder = Encoder(self.trainee, self._batches, device=self.device, bf16=self.bf16)
        if is_new and not settings.freeze_encoder:
            encoder.refresh_norms()
        self._features = encoder.encode_all(
            self.folder.features,
            mirror=settings.mirror,
            seed=settings.seed,
            should_continue=self.may_encode(stage),
        )
        if (left := len(frames) - len(self._features.frames)) > 0:
            self.note(f"{left} images were not encoded for lack of time: the head sees the rest")

    def batch_maker(self, stage: TrainingStage) -> Callable[[int], Batch]:
        settings, features = self.settings, self._features
        if features is not None:
            return lambda step: self._batches.with_features(
                step, count=settings.head_batch_size, features=features
            )
        return lambda step: self._batches.with_images(
            step, count=settings.batch_size, repeats=settings.repeats, size=stage.image_size
        )

    def losses(self, trainee: Trainee, batch: Batch) -> StepLoss:
        losses = trainee(batch, self._spread.scale)
        return StepLoss(
            total=losses.sticks + losses.direct + self.settings.gate_weight * losses.gate,
            metrics={"loss": losses.sticks, "direct_loss": losses.direct, "gate_loss": losses.gate},
        )

    def validate(self, stage: TrainingStage) -> Validation | None:
        if self._held is None:
            return None
        with computing_in(self.device, self.bf16):
            return validate(self.average, self._held_batches(self._held, stage), self._spread)

    def score(
        self, stage: TrainingStage, validation: Validation | None, *, is_last: bool
    ) -> float | None:
        if stage.image_size != self.stages[-1].image_size:
            return None
        if self._check is None:
            return None if validation is None else -validation.loss
        position = self.position
        if not is_last and position.validations % self.settings.check_every:
            return None
        trial = self.folder.path / "trial.safetensors"
        self._write(trial)
        score = self._check(trial)
        trial.unlink(missing_ok=True)
        self.folder.log({"step": position.step, "score": score})
        return score

    def export(self) -> None:
        self._write(self.settings.out)

    def _batches_of(
        self, flights: list[FlightData], indices: list[int], store: FrameStore
    ) -> Batches:
        chosen = [flights[index] for index in indices]
        return Batches(
            Timeline(chosen, self._network.contract, self._ages_ns),
            store.only(indices),
            timesteps=self._network.schedule.num_train_timesteps,
            seed=self.settings.seed,
            mirrors=self.settings.mirror,
        )

    def _held_batches(self, held: Batches, stage: TrainingStage) -> Iterable[Batch]:
        """Always the same samples; once the encoder is frozen, encoded once."""
        if self._held_features is not None:
            return self._held_features
        count = self.settings.batch_size
        batches = held.validation(samples=VALIDATION_SAMPLES, count=count, size=stage.image_size)
        moved: Iterable[Batch] = (batch.to(self.device) for batch in batches)
        if not stage.trains_encoder:
            moved = self._held_features = [self.average.encoded(batch) for batch in moved]
        return moved

    def _write(self, path: Path) -> None:
        card = training_card(
            self.settings,
            self._flights,
            self._ages_ns,
            steps=self.position.step,
            validation=self.position.kept,
        )
        policy = copy.deepcopy(self.average.policy)
        save_checkpoint(path, policy, training=card, packed=self.settings.pack)


def _ages(flights: Sequence[FlightData], settings: TrainSettings) -> Nanoseconds:
    """Sorted ages of images to train for: measured ones, or a range that is drawn from evenly."""
    if settings.age_range_ms is not None:
        low_ms, high_ms = settings.age_range_ms
        return np.linspace(low_ms * NS_PER_MS, high_ms * NS_PER_MS, 256).astype(np.int64)
    if settings.ages is not None:
        return read_ages(Path(settings.ages))
    ages = np.concatenate([flight.age_ns for flight in flights])
    ages = np.sort(ages[(ages > 0) & (ages <= MAX_AGE_MS * NS_PER_MS)])
    if len(ages) == 0:
        raise DatasetError(
            "no flight says how old its images were at a tick (feature_captured_ns): name a flight "
            "of a policy, or a range, with --ages"
        )
    return ages
