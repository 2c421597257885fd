"""Training of a policy from flights: encoder and head, then the head alone on stored features."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import update_bn

from policy.checkpoints.networks import load_checkpoint, save_checkpoint
from policy.contract import FLIGHT_TERMS
from policy.data.flight_data import FlightData, Nanoseconds
from policy.data.flight_folders import read_ages
from policy.data.interpolation import Indices
from policy.data.samples import Timeline
from policy.errors import DatasetError, PolicyError
from policy.nets.toge import Toge, TogeConfig
from policy.training.batches import (
    ENCODE_BATCH,
    Batch,
    Batches,
    StepLoss,
    normalise_image,
)
from policy.training.report import Hooks, PolicyValidation, TrainResult
from policy.training.run import TrainingRun, computing_in, work_folder
from policy.training.settings import MAX_AGE_MS, TrainingStage, TrainSettings, policy_stages
from policy.training.trainee import Trainee, validate

VALIDATION_SAMPLES = 256
NORM_IMAGES = 1024
"""Number of images for the final statistics of batch norms."""
USUAL_AGES_MS = (20.0, 90.0)
"""Image age at a tick for frames at 30 Hz and an encoder latency of 5 to 35 ms."""
FINE_TUNE_RATE = 1 / 3
"""Learning rate relative to the usual one, for pretrained weights."""
NS_PER_MS = 1_000_000
HEAD_RATE = 3
"""Learning rate relative to the usual one, for the head alone: large batches, no convolutions."""


def train_policy(
    flights: Sequence[FlightData], network: TogeConfig, settings: TrainSettings, hooks: Hooks
) -> TrainResult:
    """Train, and write the weights that are best on held-out flights to ``settings.out``."""
    with work_folder(settings) as folder:
        return _PolicyRun(flights, network, settings, hooks, folder).finish()


class _PolicyRun(TrainingRun[Trainee, Batch]):
    encoder_learns_alone = False

    def __init__(
        self,
        flights: Sequence[FlightData],
        network: TogeConfig,
        settings: TrainSettings,
        hooks: Hooks,
        folder: Path,
    ) -> None:
        self.settings: TrainSettings = settings
        self._network = network
        known_ns = _ages(flights, settings)
        self._ages_ns = known_ns if len(known_ns) else _evenly(USUAL_AGES_MS)
        trainee = _starting_trainee(network, settings)
        trainee.to(settings.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._teacher = copy.deepcopy(trainee).eval() if settings.only_end else None
        super().__init__(flights, trainee, policy_stages(settings), hooks, folder)
        timeline = Timeline(self.flights, network.contract, self._ages_ns)
        kept, self._held = (
            np.intersect1d(timeline.frames, self.frames_of(part)) for part in (self.kept, self.held)
        )
        steps = network.schedule.num_train_timesteps
        self._batches = Batches(timeline, kept, self.images, timesteps=steps, settings=settings)
        if len(known_ns) == 0:
            low_ms, high_ms = USUAL_AGES_MS
            self.note(
                f"no policy looked in these flights: image ages of {low_ms:g} to {high_ms:g} ms "
                "are assumed (--ages names a flight of a policy on this computer, or a range)"
            )
        targets = np.concatenate([self.flights[index].target for index in self.kept])
        for each in (self.trainee, self.average):
            each.set_sticks(targets)

    def check(self, flight: FlightData) -> None:
        Timeline([flight], self._network.contract, self._ages_ns)

    def learning_rate(self, stage: TrainingStage) -> float:
        if not stage.trains_encoder and self._teacher is None:
            return HEAD_RATE * self.settings.learning_rate
        return self.settings.learning_rate * (FINE_TUNE_RATE if self.settings.start_from else 1)

    def encoder(self, trainee: Trainee) -> nn.Module:
        return trainee.policy.backbone

    def encode(self) -> None:
        every = self._batches.frames
        if self._teacher is None:
            self._refresh_batch_norm(every)
        self.features = self.encode_frames(every)

    def _refresh_batch_norm(self, every: Indices) -> None:
        """Recompute the batch norms' statistics from plain images.

        The old ones were averaged while the weights changed, and fit neither weights nor images.
        """
        count = min(NORM_IMAGES, len(every))
        chosen = every[np.linspace(0, len(every) - 1, count).astype(int)]
        parts = np.array_split(chosen, max(1, count // ENCODE_BATCH))
        images = (self._normalised(self.images_of(part)) for part in parts)
        with computing_in(self.device, self.bf16):
            update_bn(images, self.trainee.policy.backbone)

    def features_of(self, images: Tensor) -> Tensor:
        features: Tensor = self.trainee.policy.backbone(self._normalised(images))
        return features

    def _normalised(self, images: Tensor) -> Tensor:
        """Return images [B, 3, H, W] as the network takes them, without augmentation."""
        return normalise_image(images.permute(0, 3, 1, 2).float() / 255, self._network.contract)

    def batch_maker(self) -> Callable[[int], Batch]:
        if (features := self.features) is not None:
            return lambda step: self._batches.with_features(step, features)
        return self._batches.with_images

    def losses(self, batch: Batch) -> StepLoss:
        loss: StepLoss = self.trainee(self._with_targets(batch))
        return loss

    def _with_targets(self, batch: Batch) -> Batch:
        return batch if self._teacher is None else self._teacher.teach(batch)

    def validate(self) -> PolicyValidation | None:
        if not self.held:
            return None
        with computing_in(self.device, self.bf16):
            batches = self._batches.validation(self._held, VALIDATION_SAMPLES)
            on_device = (batch.to(self.device) for batch in batches)
            encoded = map(self.average.encoded, on_device)
            return validate(self.average, map(self._with_targets, encoded))

    def export(self) -> None:
        card = self.card(
            flights=len(self.kept),
            images=len(self.frames_of(self.kept)),
            feature_ages_ms=(self._ages_ns[[0, -1]] / NS_PER_MS).tolist(),
        )
        policy = copy.deepcopy(self.average.policy)
        save_checkpoint(self.settings.out, policy, training=card, packed=self.settings.pack)


def _ages(flights: Sequence[FlightData], settings: TrainSettings) -> Nanoseconds:
    """Return sorted image ages to train for: measured ones, or a uniform range.

    Empty if no policy flew, as in a human pilot's flights. An image that stayed for seconds, as of
    a camera that paused, is not flown by.
    """
    if settings.age_range_ms is not None:
        return _evenly(settings.age_range_ms)
    if settings.ages is not None:
        ages = read_ages(Path(settings.ages))
    else:
        ages = np.concatenate([flight.age_ns for flight in flights])
    usable = np.sort(ages[(ages > 0) & (ages <= MAX_AGE_MS * NS_PER_MS)])
    if len(usable) == 0 and settings.ages is not None:
        raise DatasetError(f"--ages {settings.ages}: each image in it was over {MAX_AGE_MS} ms old")
    return usable


def _evenly(range_ms: tuple[float, float]) -> Nanoseconds:
    low_ms, high_ms = range_ms
    return np.linspace(low_ms * NS_PER_MS, high_ms * NS_PER_MS, 256).astype(np.int64)


def _starting_trainee(network: TogeConfig, settings: TrainSettings) -> Trainee:
    """Return the policy to start from with a new gate head; keeps torch's random state."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        if settings.start_from is not None:
            weight = 0.0 if settings.only_end else settings.gate_weight
            return Trainee(_checkpoint(network, settings.start_from), weight)
        return Trainee(Toge(network), settings.gate_weight)


def _checkpoint(network: TogeConfig, path: Path) -> Toge:
    policy = load_checkpoint(path, fallback=network)
    old, new = policy.contract, network.contract
    if old.action != new.action or not set(old.modes) & set(new.modes):
        raise PolicyError(
            f"--start-from {path} flies by {old.action} in {' or '.join(old.modes)}, these flights "
            f"were flown by {new.action} in {' or '.join(new.modes)}: start from one of their "
            "kind, or anew"
        )
    # Contract fields without a flag of this command are taken from the checkpoint, but for the end
    # that these flights teach.
    kept = {name: getattr(policy.contract, name) for name in ("feature_dim", *FLIGHT_TERMS)}
    wanted = replace(network.contract, **kept)
    asked, held = (
        {**asdict(config), "contract": None, **asdict(contract)}
        for config, contract in ((network, wanted), (policy.config, policy.contract))
    )
    other = [f"{name} {value!r}" for name, value in held.items() if asked.get(name) != value]
    if other:
        raise PolicyError(
            f"--start-from {path} holds another policy: {', '.join(other)}; ask for the same one"
        )
    policy.contract = replace(policy.contract, stops_at_end=network.contract.stops_at_end)
    policy.config = replace(policy.config, contract=policy.contract)
    return policy.train()
