"""Train a policy from flights: encoder and head, then the head alone on kept features.

    flights -> Episodes -> FrameStore (decoded once) -> Timeline -> Batches -> optimiser -> EMA
                                                                      best on held-out flights

``train_plan`` says in which stages, ``train_model`` what is optimised. Everything random follows
from the seed and the step, so a run that was killed goes on as if it had not been.
"""

import copy
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
import torch

from policy.checkpoints.policy_file import save_checkpoint
from policy.data.episodes import (
    DatasetError,
    Episode,
    Nanoseconds,
    common_frame,
    hold_out,
    measured_ages,
)
from policy.data.frames import FrameStore, store_frames
from policy.data.samples import Timeline
from policy.training.batches import Batch, Batches, PooledStore
from policy.training.encode import Encoder
from policy.training.loop import Loop, open_run
from policy.training.parallel import StepLoss, computing_in
from policy.training.plan import Check, Stage, TrainSettings, make_stages
from policy.training.report import Report, TrainResult, Validation
from policy.training.start import starting_trainee, training_card
from policy.training.state import Position, RunFolder
from policy.training.trainee import Losses, StickSpread, Trainee, validate

VALIDATION_SAMPLES = 256
FINE_TUNE = 1 / 3
"""Of the learning rate, for weights that were trained before."""
HEAD_RATE = 3
"""Times the learning rate, for the head alone: large batches, no convolutions of images."""


def train(
    episodes: Sequence[Episode],
    settings: TrainSettings,
    *,
    now_s: Callable[[], float],
    report: Report,
    should_stop: Callable[[], bool] = lambda: False,
    check: Check | None = None,
) -> TrainResult:
    """Train, and write the best weights on held-out flights to ``settings.out``.

    Args:
        episodes: the flights.
        settings: what to train and how long.
        now_s: monotonic seconds, for a budget in time.
        report: called with progress, losses and notes.
        check: flies a checkpoint in closed loop; decides in place of the validation loss.
        should_stop: asked after every step; True ends the run, to be resumed.

    Raises:
        DatasetError: flights that cannot be learned from.
        TrainingError: a run that cannot be resumed, kept, or that diverged.
        TrainingStoppedError: ``should_stop`` said so.
        PolicyError: weights to start from that do not fit.
    """
    folder = open_run(settings, episodes)
    run = _Run(list(episodes), settings, folder, now_s, report, should_stop, check)
    return run.finish()


class _Run:
    """One run, from its first step or from where it was killed."""

    def __init__(
        self,
        episodes: list[Episode],
        settings: TrainSettings,
        folder: RunFolder,
        now_s: Callable[[], float],
        report: Report,
        should_stop: Callable[[], bool],
        check: Check | None,
    ) -> None:
        self._settings, self._folder, self._check = settings, folder, check
        self._stages = make_stages(settings)
        self._contract = settings.policy.contract
        self._ages_ns = _ages(episodes, settings)
        trainee = starting_trainee(settings)
        trainee.to(settings.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        rate = settings.learning_rate * (1.0 if settings.start_from is None else FINE_TUNE)
        self._loop = Loop(
            trainee,
            settings,
            folder,
            learning_rate=rate,
            now_s=now_s,
            report=report,
            should_stop=should_stop,
        )
        self._load(episodes)
        self._pooled: PooledStore | None = None
        self._held_pooled: list[Batch] | None = None
        if settings.resume:
            self._loop.restore(self._freeze_again)
        else:
            folder.start_log()

    def finish(self) -> TrainResult:
        """All stages that are left; then the files of the run are removed."""
        position = self._loop.position
        for index in range(position.stage, len(self._stages)):
            is_new = position.step == 0 or index != position.stage
            stage = self._stages[index]
            position.stage = index
            if not stage.trains_encoder:
                self._turn_to_head(stage, is_new=is_new)
            self._train(stage)
        self._look_back(self._stages[-1], is_last=True)
        self._folder.clear()
        return TrainResult(
            checkpoint=self._settings.out,
            steps=position.step,
            validation=None if position.kept is None else Validation(**position.kept),
            score=position.best if self._check is not None else None,
        )

    # ---- flights ----

    def _load(self, episodes: list[Episode]) -> None:
        """Decode; batches of the flights to train on and of those held out."""
        store = store_frames(
            episodes,
            height=self._contract.image_height,
            width=self._contract.image_width,
            folder=self._folder.frames,
            progress=lambda fraction: self._loop.doing(f"decoding, {fraction:.0%}"),
        )
        episodes = [e.first_frames(n) for e, n in zip(episodes, store.counts, strict=True)]
        settings = self._settings
        kept, held = hold_out(episodes, settings.validation_fraction, settings.seed)
        self._episodes = [episodes[index] for index in kept]
        self._batches = self._batches_of(episodes, kept, store)
        self._held = self._batches_of(episodes, held, store) if held else None
        if not held:
            self._loop.note("no flight is held out: the last weights will be kept, not the best")
        targets = np.concatenate([episode.target for episode in self._episodes])
        self._spread = StickSpread.of(targets, self._loop.device)

    def _batches_of(
        self, episodes: list[Episode], indices: list[int], store: FrameStore
    ) -> Batches:
        chosen = [episodes[index] for index in indices]
        return Batches(
            Timeline(chosen, self._contract, self._ages_ns),
            store.only(indices),
            timesteps=self._settings.policy.schedule.num_train_timesteps,
            seed=self._settings.seed,
            mirrors=self._settings.mirror,
        )

    # ---- steps ----

    def _train(self, stage: Stage) -> None:
        def mode(trainee: Trainee) -> None:
            trainee.train()
            trainee.policy.backbone.train(stage.trains_encoder)

        self._loop.run(
            stage,
            self._stages[-1].start if self._pooled is None else 1.0,
            mode=mode,
            make=self._maker(stage),
            losses=self._losses,
            look_back=lambda: self._look_back(stage, is_last=False),
        )

    def _maker(self, stage: Stage) -> Callable[[int], Batch]:
        settings, pooled = self._settings, self._pooled
        if pooled is not None:
            return lambda step: self._batches.with_pooled(
                step, count=settings.head_batch_size, pooled=pooled
            )
        return lambda step: self._batches.with_images(
            step, count=settings.batch_size, repeats=settings.repeats, size=stage.image_size
        )

    def _losses(self, trainee: Trainee, batch: Batch) -> StepLoss:
        losses: Losses = trainee(batch, self._spread.scale)
        return StepLoss(
            total=losses.sticks + losses.direct + self._settings.gate_weight * losses.gate,
            told={"loss": losses.sticks, "direct_loss": losses.direct, "gate_loss": losses.gate},
        )

    # ---- from the encoder to the head ----

    def _turn_to_head(self, stage: Stage, *, is_new: bool) -> None:
        """Freeze the average encoder and encode all images; a resumed run has its weights."""
        loop, settings, trainee = self._loop, self._settings, self._loop.trainee
        encoder = Encoder(trainee, self._batches, device=loop.device, bf16=loop.bf16)
        if is_new:
            trainee.load_state_dict(loop.average.state_dict())
            if not settings.freeze_encoder:
                encoder.refresh_norms()
            loop.average.load_state_dict(trainee.state_dict())
        trainee.policy.backbone.requires_grad_(requires_grad=False).eval()
        go_on = loop.encoding_in(stage)
        self._pooled = encoder.encode_all(
            self._folder.pooled, mirror=settings.mirror, seed=settings.seed, go_on=go_on
        )
        if (left := len(self._batches.frames) - len(self._pooled.frames)) > 0:
            loop.note(f"{left} images were not encoded for lack of time: the head sees the rest")
        if is_new:
            loop.begin_phase(self._head_rate)

    def _freeze_again(self, position: Position) -> None:
        if not self._stages[position.stage].trains_encoder:
            self._loop.trainee.policy.backbone.requires_grad_(requires_grad=False)
            self._loop.learning_rate = self._head_rate

    @property
    def _head_rate(self) -> float:
        """Learning rate of the head alone."""
        return HEAD_RATE * self._settings.learning_rate

    # ---- what is kept ----

    def _look_back(self, stage: Stage, *, is_last: bool) -> None:
        """Validate the average weights, export them if they are the best, keep the state."""
        validation = self._validate(stage)
        score = self._score(stage, validation, is_last=is_last)
        self._loop.offer(
            score, validation, lambda: self._export(self._settings.out), is_last=is_last
        )

    def _validate(self, stage: Stage) -> Validation | None:
        if self._held is None:
            return None
        loop, batches = self._loop, self._held_batches(self._held, stage)
        with computing_in(loop.device, loop.bf16):
            validation = validate(loop.average, batches, self._spread)
        loop.tell(stage, validation)
        return validation

    def _held_batches(self, held: Batches, stage: Stage) -> Iterable[Batch]:
        """Always the same samples; once the encoder stands still, encoded once."""
        if self._held_pooled is not None:
            return self._held_pooled
        loop = self._loop
        size, count = stage.image_size, self._settings.batch_size
        batches = held.validation(samples=VALIDATION_SAMPLES, count=count, size=size)
        moved: Iterable[Batch] = (batch.to(loop.device) for batch in batches)
        if not stage.trains_encoder:
            with computing_in(loop.device, loop.bf16):
                moved = self._held_pooled = [loop.average.pooled(batch) for batch in moved]
        return moved

    def _score(self, stage: Stage, validation: Validation | None, *, is_last: bool) -> float | None:
        """More is better; None where these weights are not to be exported."""
        is_full = stage.image_size == (self._contract.image_height, self._contract.image_width)
        if not is_full:
            return None
        if self._check is None:
            return None if validation is None else -validation.loss
        position = self._loop.position
        if not is_last and position.validations % self._settings.check_every:
            return None
        trial = self._folder.path / "trial.safetensors"
        self._export(trial)
        score = self._check(trial)
        trial.unlink(missing_ok=True)
        self._folder.log({"step": position.step, "score": score})
        return score

    def _export(self, path: Path) -> None:
        position = self._loop.position
        card = training_card(
            self._settings,
            self._episodes,
            self._ages_ns,
            steps=position.step,
            validation=position.kept,
        )
        policy = copy.deepcopy(self._loop.average.policy)
        save_checkpoint(path, policy, training=card, packed=self._settings.pack)


def _ages(episodes: list[Episode], settings: TrainSettings) -> Nanoseconds:
    """Ages of images to train for, after a look at whether these flights are for this policy."""
    if (frame := common_frame(episodes)) != settings.policy.contract.state_frame:
        raise DatasetError(
            f"the flights hold {frame} states, the policy is to take "
            f"{settings.policy.contract.state_frame}"
        )
    ages = measured_ages(episodes) if settings.ages_ns is None else settings.ages_ns
    if len(ages) == 0:
        raise DatasetError(
            "no flight says how old its images were at a tick (feature_captured_ns): name a flight "
            "of a policy, or a range, with --ages"
        )
    return ages
