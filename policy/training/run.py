"""Shared base of all training runs: stages on a budget, validation, a state on disk.

    flights -> FrameStore (decoded once) -> batches with images -> encoder learns    -> moving
                `-> features (encoded once) -> batches of features -> the rest learns -> average

All random values are functions of the seed and the step, so a run that was killed continues as if
it had not been interrupted.
"""

import copy
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict
from typing import ClassVar, Generic

import numpy as np
import torch
from torch import Tensor, nn

from policy.data.flight_data import DatasetError, FlightData, common_frame, hold_out
from policy.data.frames import FrameStore, store_frames
from policy.nets.toge import BuiltinConfig
from policy.nets.world_model.config import WorldModelConfig
from policy.training.batches import ahead
from policy.training.parallel import B, Gradients, M, StepLoss, one_thread
from policy.training.report import Hooks, TrainingProgress, TrainResult, Validation
from policy.training.run_folder import (
    RunFolder,
    TrainingError,
    TrainingPosition,
    TrainingStoppedError,
    identity_of,
)
from policy.training.settings import Precision, RunSettings, TrainingStage, learning_rate_factor

LOG_STEPS = 20
"""Steps between two lines of the log."""
GRADIENT_LIMIT = 1.0
ENCODING_SHARE = 0.4
"""Share of a stage's time after which no more images are encoded for it."""


def open_run(
    settings: RunSettings, network: BuiltinConfig | WorldModelConfig, flights: Sequence[FlightData]
) -> RunFolder:
    """Open the folder of a run, to start or resume it."""
    if not settings.out.parent.is_dir():
        raise TrainingError(f"--out {settings.out}: there is no folder {settings.out.parent}")
    folder = RunFolder(settings.work_folder, identity_of(settings, network, flights))
    if folder.has_state and not settings.resume:
        raise TrainingError(
            f"{folder.path} holds an unfinished run: continue it with --resume, or remove it"
        )
    if (frame := common_frame(flights)) != network.contract.state_frame:
        raise DatasetError(
            f"the flights hold {frame} states, the network takes {network.contract.state_frame}"
        )
    return folder


class TrainingRun(ABC, Generic[M, B]):
    """Training run from its start or an interruption; subclasses define the trained module.

    Each phase of a run (the encoder learns, or it is frozen) has its own optimiser, and one rise
    and fall of its learning rate.
    """

    validation_type: ClassVar[type[Validation]]
    encoder_learns_alone: ClassVar[bool]
    settings: RunSettings

    def __init__(
        self, folder: RunFolder, trainee: M, stages: Sequence[TrainingStage], hooks: Hooks
    ) -> None:
        settings = self.settings
        self.folder, self.trainee, self.stages, self.hooks = folder, trainee, stages, hooks
        self.position = TrainingPosition()
        self.device = torch.device(settings.device)
        self.bf16 = uses_bf16(settings.precision, self.device)
        self._begun_s = hooks.now_s()
        self.average: M = copy.deepcopy(trainee).eval().requires_grad_(False)
        """Moving average of the weights, in eval mode."""
        self._optimiser = self._new_optimiser(stages[0])

    # ---- for subclasses ----

    @abstractmethod
    def encoder(self, trainee: M) -> nn.Module:
        """Return the part of a trainee that is frozen in the end."""

    @abstractmethod
    def encode(self, stage: TrainingStage, *, is_new: bool) -> None:
        """Encode the images once, for a stage on features; ``is_new`` is False when resumed."""

    @abstractmethod
    def batch_maker(self, stage: TrainingStage) -> Callable[[int], B]:
        """Return a function that creates the batch of a step; called in another thread."""

    @abstractmethod
    def losses(self, trainee: M, batch: B) -> StepLoss:
        """Return the losses of a batch or a part of it, on the device; called in threads."""

    @abstractmethod
    def validate(self, stage: TrainingStage) -> Validation | None:
        """Validate the average weights; return None if no flights were held out."""

    @abstractmethod
    def export(self) -> None:
        """Write the average weights to ``settings.out``."""

    def learning_rate(self, stage: TrainingStage) -> float:
        """Return the peak learning rate of the stage's phase."""
        return self.settings.learning_rate

    def score(self, validation: Validation | None, *, is_last: bool) -> float | None:
        """Return the score of the average weights, higher is better; None: do not export."""
        return None if validation is None else -validation.loss

    def store_flights(
        self, flights: Sequence[FlightData]
    ) -> tuple[FrameStore, list[int], list[int]]:
        """Decode all images; return the indices of the training and the held-out flights."""
        store = store_frames(
            flights,
            self.folder.frames,
            self.settings.image_size,
            progress=lambda fraction: self._report_work(f"decoding, {fraction:.0%}"),
        )
        return store, *hold_out(flights, self.settings.validation_fraction, self.settings.seed)

    def card(self, **facts: object) -> str:
        """Return facts about the training for a checkpoint's reader, as JSON."""
        asked = {n: v for n, v in vars(self.settings).items() if isinstance(v, int | float)}
        position = {"steps": self.position.step, "validation": self.position.kept}
        return json.dumps({**asked, **facts, **position}, sort_keys=True)

    def may_encode(self, stage: TrainingStage) -> Callable[[float], bool]:
        """Return a predicate of the completed share: is there time to encode more?"""
        begun = self._fraction

        def should_continue(done: float) -> bool:
            self._report_work(f"encoding, {done:.0%}")
            return self._fraction - begun < ENCODING_SHARE * (stage.end - begun)

        return should_continue

    def note(self, text: str) -> None:
        """Show the user a note."""
        self.hooks.report(TrainingProgress(stage="", fraction=0.0, step=0, note=text))

    # ---- the run ----

    def finish(self) -> TrainResult:
        """Run all remaining stages, then remove the files of the run."""
        with one_thread() as threads:
            self._run(threads)
        kept = self.position.kept
        return TrainResult(
            checkpoint=self.settings.out,
            steps=self.position.step,
            validation=None if kept is None else self.validation_type(**kept),
            score=None,
        )

    def _run(self, threads: int) -> None:
        if self.settings.resume:
            self._restore()
        else:
            self.folder.start_log()
        position = self.position
        for index in range(position.stage, len(self.stages)):
            is_new = position.step == 0 or index != position.stage
            position.stage, stage = index, self.stages[index]
            if not stage.trains_encoder:
                self._freeze_encoder(stage, is_new=is_new)
            self._train(stage, threads)
        self._validate(self.stages[-1], is_last=True)
        self.folder.clear()

    def _freeze_encoder(self, stage: TrainingStage, *, is_new: bool) -> None:
        """Train on features of the average encoder from now on; a resumed run has its weights."""
        if is_new:
            self.trainee.load_state_dict(self.average.state_dict())
        self.trainee.eval()
        self.encode(stage, is_new=is_new)
        if not is_new:
            return
        self.average.load_state_dict(self.trainee.state_dict())
        self.position.phase_step, self.position.phase_start = self.position.step, self._fraction
        self.trainee.zero_grad()  # frozen weights too: their gradients would be clipped
        self._optimiser = self._new_optimiser(stage)

    def _train(self, stage: TrainingStage, threads: int) -> None:
        position, count = self.position, self.settings.validation_count
        sums: dict[str, Tensor] = {}
        with (
            Gradients(
                self.trainee, device=self.device, bf16=self.bf16, threads=threads
            ) as gradients,
            closing(ahead(self.batch_maker(stage), position.step)) as batches,
        ):
            for replica in gradients.replicas:
                replica.train()
                self.encoder(replica).train(stage.trains_encoder)
            since = 0
            while self._fraction < stage.end:
                metrics = gradients.compute(next(batches).to(self.device), self.losses)
                self._step(stage)
                sums = {name: sums.get(name, 0.0) + value for name, value in metrics.items()}
                since += 1
                if since == LOG_STEPS:
                    self._log(stage, {name: float(value) / since for name, value in sums.items()})
                    sums, since = {}, 0
                due = int(self._fraction * count)
                if position.validations < due < count:
                    position.validations = due
                    self._validate(stage, is_last=False)
                if self.hooks.should_stop():
                    self._save()
                    self._stop()

    def _step(self, stage: TrainingStage) -> None:
        position = self.position
        start = position.phase_start
        ends = [s.end for s in self.stages if s.trains_encoder == stage.trains_encoder]
        along = (self._fraction - start) / max(ends[-1] - start, 1e-9)
        for group in self._optimiser.param_groups:
            group["lr"] = self.learning_rate(stage) * learning_rate_factor(along)
        torch.nn.utils.clip_grad_norm_(self.trainee.parameters(), GRADIENT_LIMIT)
        self._optimiser.step()
        position.step += 1
        updates = position.step - position.phase_step
        update_average(self.average, self.trainee, self.settings.ema_decay, updates)

    def _validate(self, stage: TrainingStage, *, is_last: bool) -> None:
        """Validate, export if the score is the best so far, and save the state of the run."""
        position, validation = self.position, self.validate(stage)
        if validation is not None:
            self._report(stage.name, validation=validation)
            record = {"step": position.step, "stage": stage.name}
            self.folder.log({**record, "validation": asdict(validation)})
        score = self.score(validation, is_last=is_last) if stage.is_scored else None
        if score is not None and (position.best is None or score > position.best):
            position.best, position.kept = score, None if validation is None else asdict(validation)
            self.export()
        elif is_last and position.best is None:
            self.export()
        if not is_last:
            self._save()

    @property
    def _fraction(self) -> float:
        return self.settings.fraction(self.position.step, self._spent_s)

    @property
    def _spent_s(self) -> float:
        return self.position.spent_s + self.hooks.now_s() - self._begun_s

    def _new_optimiser(self, stage: TrainingStage) -> torch.optim.AdamW:
        self.trainee.requires_grad_(not (stage.trains_encoder and self.encoder_learns_alone))
        self.encoder(self.trainee).requires_grad_(stage.trains_encoder)
        trainable = [p for p in self.trainee.parameters() if p.requires_grad]
        # No weight decay for biases, norms and other vectors.
        matrices, decay = [p for p in trainable if p.ndim >= 2], self.settings.weight_decay
        groups = [
            {"params": matrices, "weight_decay": decay},
            {"params": [p for p in trainable if p.ndim < 2], "weight_decay": 0.0},
        ]
        rate = self.learning_rate(stage)
        return torch.optim.AdamW(groups, lr=rate, betas=(0.9, 0.98), fused=True)

    def _restore(self) -> None:
        self.position, state = self.folder.load()
        self._optimiser = self._new_optimiser(self.stages[self.position.stage])
        self.trainee.load_state_dict(state["trainee"])
        self.average.load_state_dict(state["average"])
        self._optimiser.load_state_dict(state["optimiser"])

    def _save(self) -> None:
        self.position.spent_s, self._begun_s = self._spent_s, self.hooks.now_s()
        tensors = {
            "trainee": self.trainee.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self._optimiser.state_dict(),
        }
        self.folder.save(self.position, tensors)

    def _stop(self) -> None:
        if not self.folder.has_state:
            raise TrainingStoppedError("stopped before anything was learned")
        raise TrainingStoppedError("stopped: the same command with --resume continues from here")

    def _report_work(self, what: str) -> None:
        """Report progress of work other than steps, and stop on request."""
        self._report(what)
        if self.hooks.should_stop():
            self._stop()

    def _report(
        self,
        stage: str,
        *,
        losses: dict[str, float] | None = None,
        validation: Validation | None = None,
    ) -> None:
        self.hooks.report(
            TrainingProgress(
                stage=stage,
                fraction=self._fraction,
                step=self.position.step,
                losses=losses,
                validation=validation,
            )
        )

    def _log(self, stage: TrainingStage, losses: dict[str, float]) -> None:
        step = self.position.step
        if not np.isfinite(list(losses.values())).all():
            raise TrainingError(
                f"the loss is {losses['loss']} at step {step}: the training diverged; look for "
                "flights with wrong numbers, or start from other weights"
            )
        self._report(stage.name, losses=losses)
        used = {"fraction": self._fraction, "spent_s": self._spent_s}
        rate = self._optimiser.param_groups[0]["lr"]
        record = {"step": step, "stage": stage.name, **used, **losses, "learning_rate": rate}
        self.folder.log(record)


@torch.no_grad()
def update_average(average: nn.Module, trainee: nn.Module, decay: float, updates: int) -> None:
    """Update an exponential moving average of weights, faster in the first of ``updates``.

    Frozen weights are equal in both and are skipped; counters are copied.
    """
    weight = 1.0 - min(decay, (1 + updates) / (10 + updates))
    frozen = {name for name, one in trainee.named_parameters() if not one.requires_grad}
    new = {name: one for name, one in trainee.state_dict().items() if name not in frozen}
    old = average.state_dict()
    names = [name for name, value in new.items() if value.is_floating_point()]
    torch._foreach_lerp_(  # one call for some thousand tensors
        [old[name] for name in names], [new[name] for name in names], weight
    )
    for name in new.keys() - set(names):
        old[name].copy_(new[name])


def uses_bf16(precision: Precision, device: torch.device) -> bool:
    """True to compute in bfloat16; ``auto`` does so if the hardware multiplies it."""
    if precision != "auto":
        return precision == "bf16"
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    return device.type == "cpu" and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
