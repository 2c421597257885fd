"""Train a policy from flights: encoder and head, then the head alone on kept features.

    flights -> Episodes -> FrameStore (decoded once) -> Timeline -> Batches -> optimiser -> EMA
                                                                      best on held-out flights

``train_plan`` says in which stages, ``train_model`` what is optimised. Everything random follows
from the seed and the step, so a run that was killed goes on as if it had not been.
"""

import copy
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from policy.checkpoint import save_checkpoint
from policy.dataset import DatasetError, Episode, Nanoseconds, common_frame, hold_out, measured_ages
from policy.dataset_frames import FrameStore, store_frames
from policy.dataset_samples import Timeline
from policy.train_batches import Batch, Batches, PooledStore, ahead
from policy.train_encode import Encoder
from policy.train_model import (
    GRADIENT_LIMIT,
    Ema,
    StickSpread,
    computing_in,
    make_optimiser,
    uses_bf16,
    validate,
)
from policy.train_parallel import Gradients
from policy.train_plan import (
    Check,
    Stage,
    TrainSettings,
    learning_rate_factor,
    make_stages,
)
from policy.train_report import Progress, Report, TrainResult, Validation
from policy.train_start import starting_trainee, training_card
from policy.train_state import Position, RunFolder, TrainingError, identity_of

VALIDATION_SAMPLES = 256
LOG_STEPS = 20
"""Steps between two lines of the log."""
FINE_TUNE = 1 / 3
"""Of the learning rate, for weights that were trained before."""
ENCODING_SHARE = 0.4
"""Of the head's time, the most that goes into encoding images for it."""


def train(
    episodes: Sequence[Episode],
    settings: TrainSettings,
    *,
    now_s: Callable[[], float],
    report: Report,
    check: Check | None = None,
) -> TrainResult:
    """Train, and write the best weights on held-out flights to ``settings.out``.

    Args:
        episodes: the flights.
        settings: what to train and how long.
        now_s: monotonic seconds, for a budget in time.
        report: called with progress, losses and notes.
        check: flies a checkpoint in closed loop; decides in place of the validation loss.

    Raises:
        DatasetError: flights that cannot be learned from.
        TrainingError: a run that cannot be resumed, kept, or that diverged.
        PolicyError: weights to start from that do not fit.
    """
    if not settings.out.parent.is_dir():
        raise TrainingError(f"--out {settings.out}: there is no folder {settings.out.parent}")
    folder = RunFolder(settings.work_folder, identity_of(settings, episodes))
    if folder.has_state and not settings.resume:
        raise TrainingError(
            f"{folder.path} holds an unfinished run: go on with --resume, or remove it"
        )
    run = _Run(list(episodes), settings, folder, now_s, report, check)
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
        check: Check | None,
    ) -> None:
        self._settings, self._folder, self._check = settings, folder, check
        self._now_s, self._report, self._begun_s = now_s, report, now_s()
        self._device = torch.device(settings.device)
        self._bf16 = uses_bf16(settings.precision, self._device)
        self._stages = make_stages(settings)
        self._contract = settings.policy.contract
        self._ages_ns = _ages(episodes, settings)
        self._load(episodes)
        self._trainee = starting_trainee(settings)
        self._trainee.to(self._device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._ema = Ema(self._trainee, settings.ema_decay)
        self._position = Position()
        self._optimiser = self._new_optimiser()
        self._pooled: PooledStore | None = None
        if settings.resume:
            self._restore()
        else:
            folder.start_log()

    def finish(self) -> TrainResult:
        """All stages that are left; then the files of the run are removed."""
        position = self._position
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
        store = self._decode(episodes)
        episodes = [e.first_frames(n) for e, n in zip(episodes, store.counts, strict=True)]
        settings = self._settings
        kept, held = hold_out(episodes, settings.validation_fraction, settings.seed)
        self._episodes = [episodes[index] for index in kept]
        self._batches = self._batches_of(episodes, kept, store)
        self._held = self._batches_of(episodes, held, store) if held else None
        if not held:
            self._note("no flight is held out: the last weights will be kept, not the best")
        targets = np.concatenate([episode.target for episode in self._episodes])
        self._spread = StickSpread.of(targets, self._device)

    def _decode(self, episodes: list[Episode]) -> FrameStore:
        def progress(fraction: float) -> None:
            self._report(Progress(stage=f"decoding, {fraction:.0%}", fraction=0.0, step=0))

        return store_frames(
            episodes,
            height=self._contract.image_height,
            width=self._contract.image_width,
            folder=self._folder.frames,
            progress=progress,
        )

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
        position, sums, since = self._position, torch.zeros(2, device=self._device), 0
        with (
            Gradients(self._trainee, device=self._device, bf16=self._bf16) as gradients,
            closing(ahead(self._maker(stage), position.step)) as batches,
        ):
            gradients.set_mode(trains_encoder=stage.trains_encoder)
            while self._fraction() < stage.end:
                sums += self._step(next(batches).to(self._device), gradients)
                since += 1
                if since == LOG_STEPS:
                    self._log(stage, (sums / since).tolist())
                    sums, since = torch.zeros(2, device=self._device), 0
                due = int(self._fraction() * self._settings.validation_count)
                if position.validations < due < self._settings.validation_count:
                    position.validations = due
                    self._look_back(stage, is_last=False)

    def _maker(self, stage: Stage) -> Callable[[int], Batch]:
        settings, pooled = self._settings, self._pooled
        if pooled is not None:
            return lambda step: self._batches.with_pooled(
                step, count=settings.head_batch_size, pooled=pooled
            )
        return lambda step: self._batches.with_images(
            step, count=settings.batch_size, repeats=settings.repeats, size=stage.image_size
        )

    def _step(self, batch: Batch, gradients: Gradients) -> Tensor:
        """One step of the optimiser; the losses [2], of sticks and gates."""
        position, settings = self._position, self._settings
        factor = learning_rate_factor(self._along_phase())
        for group in self._optimiser.param_groups:
            group["lr"] = self._learning_rate * factor
        losses = gradients.compute(batch, self._spread.scale, settings.gate_weight)
        torch.nn.utils.clip_grad_norm_(self._trainee.parameters(), GRADIENT_LIMIT)
        self._optimiser.step()
        position.step += 1
        self._ema.update(self._trainee, position.step - position.phase_step)
        return losses

    def _along_phase(self) -> float:
        """How much of encoder-and-head, or of the head alone, is done."""
        start = self._position.phase_start
        end = self._stages[-1].start if self._pooled is None else 1.0
        return (self._fraction() - start) / max(end - start, 1e-9)

    @property
    def _learning_rate(self) -> float:
        is_trained = self._settings.start_from is not None
        return self._settings.learning_rate * (FINE_TUNE if is_trained else 1.0)

    def _new_optimiser(self) -> torch.optim.AdamW:
        return make_optimiser(self._trainee, self._learning_rate, self._settings.weight_decay)

    def _spent_s(self) -> float:
        return self._position.spent_s + self._now_s() - self._begun_s

    def _fraction(self) -> float:
        return self._settings.budget.fraction(self._position.step, self._spent_s())

    # ---- from the encoder to the head ----

    def _turn_to_head(self, stage: Stage, *, is_new: bool) -> None:
        """Freeze the average encoder and encode all images; a resumed run has its weights."""
        position, settings = self._position, self._settings
        trainee = self._trainee
        encoder = Encoder(trainee, self._batches, device=self._device, bf16=self._bf16)
        if is_new:
            trainee.load_state_dict(self._ema.average.state_dict())
            if not settings.freeze_encoder:
                encoder.refresh_norms()
            self._ema.average.load_state_dict(trainee.state_dict())
        trainee.policy.backbone.requires_grad_(requires_grad=False).eval()
        begun = self._fraction()

        def go_on(done: float) -> bool:
            self._report(
                Progress(
                    stage=f"encoding, {done:.0%}", fraction=self._fraction(), step=position.step
                )
            )
            return self._fraction() - begun < ENCODING_SHARE * (stage.end - begun)

        self._pooled = encoder.encode_all(
            self._folder.pooled, mirror=settings.mirror, seed=settings.seed, go_on=go_on
        )
        if (left := len(self._batches.frames) - len(self._pooled.frames)) > 0:
            self._note(f"{left} images were not encoded for lack of time: the head sees the rest")
        if is_new:
            position.phase_step, position.phase_start = position.step, self._fraction()
            self._optimiser = self._new_optimiser()

    # ---- what is kept ----

    def _look_back(self, stage: Stage, *, is_last: bool) -> None:
        """Validate the average weights, export them if they are the best, keep the state."""
        validation = self._validate(stage)
        score = self._score(stage, validation, is_last=is_last)
        position = self._position
        if score is not None and (position.best is None or score > position.best):
            position.best, position.kept = score, None if validation is None else asdict(validation)
            self._export(self._settings.out)
        elif is_last and position.best is None:
            self._export(self._settings.out)
        if not is_last:
            self._save_state()

    def _validate(self, stage: Stage) -> Validation | None:
        if self._held is None:
            return None
        batches = self._held.validation(
            samples=VALIDATION_SAMPLES, count=self._settings.batch_size, size=stage.image_size
        )
        moved = (batch.to(self._device) for batch in batches)
        with computing_in(self._device, self._bf16):
            validation = validate(self._ema.average, moved, self._spread)
        fraction, step = self._fraction(), self._position.step
        self._report(
            Progress(stage=stage.name, fraction=fraction, step=step, validation=validation)
        )
        self._folder.log({"step": step, "stage": stage.name, "validation": asdict(validation)})
        return validation

    def _score(self, stage: Stage, validation: Validation | None, *, is_last: bool) -> float | None:
        """More is better; None where these weights are not to be exported."""
        is_full = stage.image_size == (self._contract.image_height, self._contract.image_width)
        if not is_full:
            return None
        if self._check is None:
            return None if validation is None else -validation.loss
        if not is_last and self._position.validations % self._settings.check_every:
            return None
        trial = self._folder.path / "trial.safetensors"
        self._export(trial)
        score = self._check(trial)
        trial.unlink(missing_ok=True)
        self._folder.log({"step": self._position.step, "score": score})
        return score

    def _export(self, path: Path) -> None:
        position = self._position
        card = training_card(
            self._settings,
            self._episodes,
            self._ages_ns,
            steps=position.step,
            validation=position.kept,
        )
        policy = copy.deepcopy(self._ema.average.policy)
        save_checkpoint(path, policy, training=card, packed=self._settings.pack)

    def _save_state(self) -> None:
        position = self._position
        position.spent_s, self._begun_s = self._spent_s(), self._now_s()
        self._folder.save(
            position,
            {
                "trainee": self._trainee.state_dict(),
                "average": self._ema.average.state_dict(),
                "optimiser": self._optimiser.state_dict(),
            },
        )

    def _restore(self) -> None:
        self._position, state = self._folder.load()
        if not self._stages[self._position.stage].trains_encoder:
            self._trainee.policy.backbone.requires_grad_(requires_grad=False)
            self._optimiser = self._new_optimiser()
        self._trainee.load_state_dict(state["trainee"])
        self._ema.average.load_state_dict(state["average"])
        self._optimiser.load_state_dict(state["optimiser"])

    # ---- what is told ----

    def _note(self, text: str) -> None:
        self._report(Progress(stage="", fraction=0.0, step=0, note=text))

    def _log(self, stage: Stage, losses: list[float]) -> None:
        loss, gate_loss = losses
        step, fraction = self._position.step, self._fraction()
        if not np.isfinite(loss + gate_loss):
            raise TrainingError(
                f"the loss is {loss} at step {step}: the training diverged; look for flights with "
                "wrong numbers, or start from other weights"
            )
        self._report(
            Progress(stage=stage.name, fraction=fraction, step=step, loss=loss, gate_loss=gate_loss)
        )
        self._folder.log(
            {
                "step": step,
                "stage": stage.name,
                "fraction": fraction,
                "spent_s": self._spent_s(),
                "loss": loss,
                "gate_loss": gate_loss,
                "learning_rate": self._optimiser.param_groups[0]["lr"],
            }
        )


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
