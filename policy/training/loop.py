"""What every training run does: steps on a budget, an average of the weights, a state on disk."""

import copy
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict
from typing import Generic

import numpy as np
import torch
from torch import Tensor, nn

from policy.data.episodes import Episode
from policy.training.batches import ahead
from policy.training.parallel import B, Gradients, M, StepLoss
from policy.training.plan import RunSettings, Span, learning_rate_factor
from policy.training.report import Held, Progress, Report
from policy.training.state import (
    Position,
    RunFolder,
    TrainingError,
    TrainingStoppedError,
    identity_of,
)

LOG_STEPS = 20
"""Steps between two lines of the log."""
GRADIENT_LIMIT = 1.0
ENCODING_SHARE = 0.4
"""Of the time of a stage on kept features, the most that goes into encoding images for it."""


def open_run(settings: RunSettings, episodes: Sequence[Episode]) -> RunFolder:
    """The folder of a run that may begin, or go on if that is asked for.

    Raises:
        TrainingError: no folder for the checkpoint, or a run that is there already.
    """
    if not settings.out.parent.is_dir():
        raise TrainingError(f"--out {settings.out}: there is no folder {settings.out.parent}")
    folder = RunFolder(settings.work_folder, identity_of(settings, episodes))
    if folder.has_state and not settings.resume:
        raise TrainingError(
            f"{folder.path} holds an unfinished run: go on with --resume, or remove it"
        )
    return folder


class Loop(Generic[M]):
    """The steps of one run. A phase of it has one optimiser and one rise and fall of its rate."""

    def __init__(
        self,
        trainee: M,
        settings: RunSettings,
        folder: RunFolder,
        *,
        learning_rate: float,
        now_s: Callable[[], float],
        report: Report,
        should_stop: Callable[[], bool],
    ) -> None:
        self.trainee, self.folder, self.position = trainee, folder, Position()
        self.device = torch.device(settings.device)
        self.bf16 = uses_bf16(settings.precision, self.device)
        self._settings, self.learning_rate = settings, learning_rate
        self._now_s, self._report, self._begun_s = now_s, report, now_s()
        self._should_stop = should_stop
        self._ema = Ema(trainee, settings.ema_decay)
        self._optimiser = self._new_optimiser()

    @property
    def average(self) -> M:
        """The average of the weights, in eval mode."""
        return self._ema.average

    @property
    def fraction(self) -> float:
        """How much of the budget is used."""
        return self._settings.budget.fraction(self.position.step, self.spent_s)

    @property
    def spent_s(self) -> float:
        """Time used, that before a resume included."""
        return self.position.spent_s + self._now_s() - self._begun_s

    def begin_phase(self, learning_rate: float) -> None:
        """What may move has changed: a new optimiser, and a learning rate that rises and falls."""
        self.learning_rate = learning_rate
        self.position.phase_step, self.position.phase_start = self.position.step, self.fraction
        self.trainee.zero_grad()  # of what stands still from now on, too: they would be clipped
        self._optimiser = self._new_optimiser()

    def run(
        self,
        stage: Span,
        phase_end: float,
        *,
        mode: Callable[[M], object],
        make: Callable[[int], B],
        losses: Callable[[M, B], StepLoss],
        look_back: Callable[[], None],
    ) -> None:
        """Steps until the end of the stage.

        Args:
            stage: a part of the budget.
            phase_end: fraction of the budget at which the learning rate has fallen.
            mode: puts a trainee into the mode of this stage.
            make: the batch of a step, called in another thread.
            losses: of a trainee on a batch or a part of it, on the device; called in threads.
            look_back: called when a validation is due.

        Raises:
            TrainingError: the loss is no longer finite, or there is no room for the log.
            TrainingStoppedError: somebody wants the run to end; its state is kept.
        """
        position, count = self.position, self._settings.validation_count
        sums: dict[str, Tensor] = {}
        since = 0
        with (
            Gradients(self.trainee, device=self.device, bf16=self.bf16) as gradients,
            closing(ahead(make, position.step)) as batches,
        ):
            gradients.each(mode)
            while self.fraction < stage.end:
                told = gradients.compute(next(batches).to(self.device), losses)
                self._step(phase_end)
                for name, value in told.items():
                    sums[name] = sums[name] + value if name in sums else value
                since += 1
                if since == LOG_STEPS:
                    self._log(stage, {name: float(value) / since for name, value in sums.items()})
                    sums, since = {}, 0
                due = int(self.fraction * count)
                if position.validations < due < count:
                    position.validations = due
                    look_back()
                if self._should_stop():
                    self._save()
                    raise self._stopped()

    def offer(
        self,
        score: float | None,
        validation: Held | None,
        export: Callable[[], None],
        *,
        is_last: bool,
    ) -> None:
        """Export the average weights if their score is the best so far, then keep the state.

        Args:
            score: more is better; None where these weights are not to be exported.
            validation: of these weights.
            export: writes them.
            is_last: the run is over: something must be exported, and no state kept.
        """
        position = self.position
        if score is not None and (position.best is None or score > position.best):
            position.best, position.kept = score, None if validation is None else asdict(validation)
            export()
        elif is_last and position.best is None:
            export()
        if not is_last:
            self._save()

    def restore(self, prepare: Callable[[Position], None]) -> None:
        """Go on from the state on disk; ``prepare`` says what may move, as it was then.

        Raises:
            TrainingError: there is none, it is damaged, or of another run.
        """
        self.position, state = self.folder.load()
        prepare(self.position)
        self._optimiser = self._new_optimiser()
        self.trainee.load_state_dict(state["trainee"])
        self.average.load_state_dict(state["average"])
        self._optimiser.load_state_dict(state["optimiser"])

    def encoding_in(self, stage: Span) -> Callable[[float], bool]:
        """Whether there is time to go on encoding for ``stage``, asked with the part done."""
        begun = self.fraction

        def go_on(done: float) -> bool:
            self.doing(f"encoding, {done:.0%}")
            return self.fraction - begun < ENCODING_SHARE * (stage.end - begun)

        return go_on

    def tell(self, stage: Span, validation: Held) -> None:
        """A validation, to the person and the log."""
        step = self.position.step
        told = Progress(stage=stage.name, fraction=self.fraction, step=step, validation=validation)
        self._report(told)
        self.folder.log({"step": step, "stage": stage.name, "validation": asdict(validation)})

    def note(self, text: str) -> None:
        """Something that a person should know."""
        self._report(Progress(stage="", fraction=0.0, step=0, note=text))

    def doing(self, what: str) -> None:
        """What is done in place of steps.

        Raises:
            TrainingStoppedError: somebody wants the run to end.
        """
        told = Progress(stage=what, fraction=self.fraction, step=self.position.step)
        self._report(told)
        if self._should_stop():
            raise self._stopped()

    def _step(self, phase_end: float) -> None:
        """Along the gradients that are there."""
        position = self.position
        start = position.phase_start
        along = (self.fraction - start) / max(phase_end - start, 1e-9)
        for group in self._optimiser.param_groups:
            group["lr"] = self.learning_rate * learning_rate_factor(along)
        torch.nn.utils.clip_grad_norm_(self.trainee.parameters(), GRADIENT_LIMIT)
        self._optimiser.step()
        position.step += 1
        self._ema.update(self.trainee, position.step - position.phase_step)

    def _new_optimiser(self) -> torch.optim.AdamW:
        return make_optimiser(self.trainee, self.learning_rate, self._settings.weight_decay)

    def _stopped(self) -> TrainingStoppedError:
        if not self.folder.has_state:
            return TrainingStoppedError("stopped before anything was learned")
        return TrainingStoppedError("stopped: the same command with --resume goes on from here")

    def _save(self) -> None:
        position = self.position
        position.spent_s, self._begun_s = self.spent_s, self._now_s()
        self.folder.save(
            position,
            {
                "trainee": self.trainee.state_dict(),
                "average": self.average.state_dict(),
                "optimiser": self._optimiser.state_dict(),
            },
        )

    def _log(self, stage: Span, losses: dict[str, float]) -> None:
        step, fraction = self.position.step, self.fraction
        if not np.isfinite(list(losses.values())).all():
            raise TrainingError(
                f"the loss is {losses['loss']} at step {step}: the training diverged; look for "
                "flights with wrong numbers, or start from other weights"
            )
        self._report(Progress(stage=stage.name, fraction=fraction, step=step, losses=losses))
        self.folder.log(
            {
                "step": step,
                "stage": stage.name,
                "fraction": fraction,
                "spent_s": self.spent_s,
                **losses,
                "learning_rate": self._optimiser.param_groups[0]["lr"],
            }
        )


class Ema(Generic[M]):
    """An exponential moving average of a trainee, itself a trainee in eval mode."""

    def __init__(self, trainee: M, decay: float) -> None:
        self.average = copy.deepcopy(trainee).eval().requires_grad_(False)
        self._decay = decay

    @torch.no_grad()
    def update(self, trainee: M, updates: int) -> None:
        """Move towards ``trainee``, faster in the first of ``updates``; counters are copied.

        Weights that do not move are the same in both, and are left alone.
        """
        weight = 1.0 - min(self._decay, (1 + updates) / (10 + updates))
        still = {name for name, one in trainee.named_parameters() if not one.requires_grad}
        its = {name: one for name, one in trainee.state_dict().items() if name not in still}
        mine = self.average.state_dict()
        names = [name for name, value in its.items() if value.is_floating_point()]
        torch._foreach_lerp_(  # one call for some thousand tensors
            [mine[name] for name in names], [its[name] for name in names], weight
        )
        for name in its.keys() - set(names):
            mine[name].copy_(its[name])


def make_optimiser(trainee: nn.Module, learning_rate: float, decay: float) -> torch.optim.AdamW:
    """AdamW over what may move; biases, norms and embeddings of one row are not decayed."""
    moving = [p for p in trainee.parameters() if p.requires_grad]
    groups = [
        {"params": [p for p in moving if p.ndim >= 2], "weight_decay": decay},
        {"params": [p for p in moving if p.ndim < 2], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=learning_rate, betas=(0.9, 0.98), fused=True)


def uses_bf16(precision: str, device: torch.device) -> bool:
    """Whether to compute in bfloat16; ``auto`` does where the hardware multiplies it."""
    if precision != "auto":
        return precision == "bf16"
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    return device.type == "cpu" and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
