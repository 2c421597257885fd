"""Shared base of all training runs: stages on a budget, validation, the best weights on disk.

    flights -> images (decoded once) -> batches with images -> encoder learns    -> moving
                `-> features (encoded once) -> batches of features -> the rest learns -> average

All random values are functions of the seed and the step, so equal runs give equal weights.
"""

import copy
import errno
import json
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from policy.data.flight_data import FlightData, hold_out
from policy.data.frames import store_frames
from policy.data.interpolation import Indices
from policy.engines.torch_engines import FasterThreads, torch_threads
from policy.errors import DatasetError, PolicyError
from policy.training.batches import ENCODE_BATCH, FeatureStore, StepLoss, TensorBatch, ahead
from policy.training.report import Hooks, TrainingProgress, TrainResult, Validation
from policy.training.settings import Precision, RunSettings, TrainingStage, learning_rate_factor

LOG_STEPS = 20
"""Steps between two lines of the log."""
GRADIENT_LIMIT = 1.0
M = TypeVar("M", bound=nn.Module)
B = TypeVar("B", bound=TensorBatch)


class TrainingError(PolicyError):
    """Run that cannot start or go on; the message names the next step."""


class TrainingStoppedError(PolicyError):
    """The run was asked to stop; the message says what is kept."""


@contextmanager
def work_folder(settings: RunSettings) -> Iterator[Path]:
    """Context manager: the folder of a run, in which only the log stays."""
    if not settings.out.parent.is_dir():
        raise TrainingError(f"--out {settings.out}: there is no folder {settings.out.parent}")
    folder = settings.work_folder
    try:
        folder.mkdir(exist_ok=True)
        (folder / "log.jsonl").unlink(missing_ok=True)
        shutil.rmtree(folder / "data", ignore_errors=True)  # of a run that was killed
        yield folder
    except OSError as error:
        told: object = error.strerror or error
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            told = "the disk is full: make room, or write --out elsewhere"
        raise TrainingError(f"{folder}: {told}") from error
    finally:
        shutil.rmtree(folder / "data", ignore_errors=True)
        with suppress(OSError):  # it holds a log, unless the run was refused
            folder.rmdir()


class TrainingRun(ABC, Generic[M, B]):
    """One training run; subclasses define the trained module.

    Each stage (the encoder learns, or it is frozen) has its own optimiser, and one rise and fall of
    its learning rate.
    """

    encoder_learns_alone: ClassVar[bool]
    """True: all else is frozen while the encoder learns, and none of these weights are exported."""
    settings: RunSettings

    def __init__(
        self,
        flights: Sequence[FlightData],
        trainee: M,
        stages: Sequence[TrainingStage],
        hooks: Hooks,
        folder: Path,
    ) -> None:
        """Leave out the flights that ``check`` refuses, and decode all images into ``folder``."""
        settings = self.settings
        self.trainee, self.stages, self.hooks = trainee, stages, hooks
        self.device = torch.device(settings.device)
        self.bf16 = uses_bf16(settings.precision, self.device)
        self.step = 0
        """Completed optimiser steps."""
        self._path = folder / "data" / "features.f16"
        self.features: FeatureStore | None = None
        """None until the encoder is frozen."""
        self.average: M = copy.deepcopy(trainee).eval().requires_grad_(False)
        """Moving average of the weights, in eval mode."""
        self._log, self._begun_s = folder / "log.jsonl", hooks.now_s()
        self._stage_step, self._stage_start = 0, 0.0
        self._validations = 0
        self._best: Validation | None = None
        self._is_exported = False
        self.flights = self._useful(flights)
        self.kept, self.held = hold_out(self.flights, settings.validation_fraction, settings.seed)
        """Indices in ``flights`` of the flights to learn from, and of those that are held out."""
        if not self.held:
            self.note("no flight is held out: the last weights will be kept, not the best")
        (folder / "data").mkdir()
        self.images, shapes = store_frames(
            self.flights,
            folder / "data" / "frames.rgb",
            settings.image_size,
            progress=lambda done: self.report_work(f"decoding, {done:.0%}"),
        )
        """[N, height, width, 3] uint8 of all flights."""
        if len(shapes) > 1:
            told = ", ".join(f"{each:g}" for each in shapes)
            self.note(
                f"the images have different proportions (width by height {told}) and are all made "
                "square, so that one thing has several shapes: train on one camera's flights"
            )
        self._begun_s = hooks.now_s()

    # ---- for subclasses ----

    @abstractmethod
    def check(self, flight: FlightData) -> None:
        """Raise DatasetError if nothing can be learned from a flight."""

    @abstractmethod
    def encoder(self, trainee: M) -> nn.Module:
        """Return the part of a trainee that is frozen in the end."""

    @abstractmethod
    def features_of(self, images: Tensor) -> Tensor:
        """Return the encoder's features [B, D] of images [B, height, width, 3] uint8."""

    @abstractmethod
    def encode(self) -> None:
        """Set ``features``, by ``encode_frames``, for the stage on them."""

    @abstractmethod
    def batch_maker(self) -> Callable[[int], B]:
        """Return a function that creates the batch of a step; called in another thread."""

    @abstractmethod
    def losses(self, batch: B) -> StepLoss:
        """Return the losses of a batch on the device."""

    @abstractmethod
    def validate(self) -> Validation | None:
        """Validate the average weights; return None if no flights are held out."""

    @abstractmethod
    def export(self) -> None:
        """Write the average weights to ``settings.out``."""

    def frames_of(self, flights: Sequence[int]) -> Indices:
        """Return the numbers of the images of some flights."""
        counts = [len(flight.captured_ns) for flight in self.flights]
        return np.flatnonzero(np.isin(np.repeat(np.arange(len(counts)), counts), flights))

    def images_of(self, frames: Indices, *, is_mirrored: bool = False) -> Tensor:
        """Return images [..., height, width, 3] on the device, plain or all mirrored."""
        images = torch.from_numpy(self.images[frames])
        return (images.flip(-2) if is_mirrored else images).to(self.device)

    @torch.no_grad()
    def encode_frames(self, frames: Indices) -> FeatureStore:
        """Return the features of images with ascending numbers, mirrored too if asked for."""
        ways = (False, True) if self.settings.mirror else (False,)
        parts = np.array_split(frames, -(-len(frames) // ENCODE_BATCH))
        with self._path.open("wb") as file:
            for done, (way, part) in enumerate(product(ways, parts)):
                with computing_in(self.device, self.bf16):
                    encoded = self.features_of(self.images_of(part, is_mirrored=way))
                file.write(encoded.to(torch.float16).cpu().numpy().tobytes())
                self.report_work(f"encoding, {done / (len(ways) * len(parts)):.0%}")
        rows = np.memmap(self._path, np.float16, mode="r").reshape(len(ways), len(frames), -1)
        return FeatureStore(rows, frames)

    def learning_rate(self, stage: TrainingStage) -> float:
        """Return the peak learning rate of a stage."""
        return self.settings.learning_rate

    def card(self, **facts: object) -> str:
        """Return facts about the training for a checkpoint's reader, as JSON."""
        asked = {n: v for n, v in vars(self.settings).items() if isinstance(v, int | float)}
        validation = None if self._best is None else asdict(self._best)
        return json.dumps(
            {**asked, **facts, "steps": self.step, "validation": validation}, sort_keys=True
        )

    def note(self, text: str) -> None:
        """Show the user a note."""
        self.hooks.report(TrainingProgress(stage="", fraction=0.0, step=0, note=text))

    def report_work(self, what: str) -> None:
        """Report progress of work other than steps, and stop on request."""
        self._report(what)
        if self.hooks.should_stop():
            self._stop()

    # ---- the run ----

    def finish(self) -> TrainResult:
        """Run all stages."""
        with torch_threads(torch.get_num_threads()):  # trials change them
            for stage in self.stages:
                if not stage.trains_encoder:
                    self._freeze_encoder()
                self._train(stage)
        if self.step == 0:
            raise TrainingError("the time was over before the first step: give more --minutes")
        self._validate(self.stages[-1])
        return TrainResult(checkpoint=self.settings.out, steps=self.step, validation=self._best)

    def _useful(self, flights: Sequence[FlightData]) -> list[FlightData]:
        useful, refused = [], []
        for flight in flights:
            try:
                self.check(flight)
            except DatasetError as error:
                refused.append(error)
            else:
                useful.append(flight)
        if refused and not useful:
            raise refused[0]
        for reason in refused:
            self.note(f"left out: {reason}")
        return useful

    def _freeze_encoder(self) -> None:
        """Train on features of the average encoder from now on."""
        self.trainee.load_state_dict(self.average.state_dict())
        self.trainee.eval()
        encoding_s = self.hooks.now_s()
        self.encode()
        self._begun_s += self.hooks.now_s() - encoding_s
        self.average.load_state_dict(self.trainee.state_dict())

    def _train(self, stage: TrainingStage) -> None:
        count = self.settings.validation_count
        self._stage_step, self._stage_start = self.step, self._fraction
        optimiser = self._new_optimiser(stage)
        sums: dict[str, Tensor] = {}
        # Sums of other threads differ in the last bit: equal runs by --steps stay equal.
        is_tried = self.settings.steps is None and self.device.type == "cpu"
        threads = FasterThreads(self.hooks.now_s).step if is_tried else nullcontext
        self.trainee.train()
        self.encoder(self.trainee).train(stage.trains_encoder)
        with closing(ahead(self.batch_maker(), self.step)) as batches:
            since = 0
            while self._fraction < stage.end:
                batch = next(batches).to(self.device)
                with threads():
                    metrics = self._set_gradients(batch)
                # On cores shared with another program, threads that wait for each other in every
                # small operator of this took a hundred times the processor time of one.
                with torch_threads(1):
                    rate = self._step(stage, optimiser)
                sums = {name: sums.get(name, 0.0) + value for name, value in metrics.items()}
                since += 1
                if since == LOG_STEPS:
                    means = {name: float(value) / since for name, value in sums.items()}
                    self._log_losses(stage, means, rate)
                    sums, since = {}, 0
                due = int(self._fraction * count)
                if self._validations < due < count:
                    self._validations = due
                    self._validate(stage)
                if self.hooks.should_stop():
                    if self._is_exported or not self.settings.out.exists():
                        self._validate(stage)
                    self._stop()

    def _set_gradients(self, batch: B) -> dict[str, Tensor]:
        self.trainee.zero_grad()
        with computing_in(self.device, self.bf16):
            loss = self.losses(batch)
        torch.autograd.backward(loss.total)
        return {name: value.detach() for name, value in loss.metrics.items()}

    def _step(self, stage: TrainingStage, optimiser: torch.optim.Optimizer) -> float:
        """Take one step with the computed gradients; return its learning rate."""
        along = (self._fraction - self._stage_start) / max(stage.end - self._stage_start, 1e-9)
        rate = self.learning_rate(stage) * learning_rate_factor(along)
        for group in optimiser.param_groups:
            group["lr"] = rate
        torch.nn.utils.clip_grad_norm_(self.trainee.parameters(), GRADIENT_LIMIT)
        optimiser.step()
        self.step += 1
        updates = self.step - self._stage_step
        update_average(self.average, self.trainee, self.settings.ema_decay, updates)
        return rate

    def _validate(self, stage: TrainingStage) -> None:
        """Validate; export the weights if they are the best so far, or if nothing is held out."""
        validation = self.validate()
        if validation is not None:
            self._report(stage.name, validation=validation)
            self._write_log(stage, validation=asdict(validation))
        if stage.trains_encoder and self.encoder_learns_alone:
            return
        best = self._best
        if validation is None or best is None or validation.selected_by < best.selected_by:
            self._best, self._is_exported = validation, True
            self.export()

    @property
    def _fraction(self) -> float:
        return self.settings.fraction(self.step, self.hooks.now_s() - self._begun_s)

    def _new_optimiser(self, stage: TrainingStage) -> torch.optim.AdamW:
        self.trainee.requires_grad_(not (stage.trains_encoder and self.encoder_learns_alone))
        self.encoder(self.trainee).requires_grad_(stage.trains_encoder)
        trainable = [p for p in self.trainee.parameters() if p.requires_grad]
        # No weight decay for biases, norms and other vectors.
        groups = [
            {"params": [p for p in trainable if (p.ndim >= 2) == is_matrix], "weight_decay": decay}
            for is_matrix, decay in ((True, self.settings.weight_decay), (False, 0.0))
        ]
        return torch.optim.AdamW(groups, betas=(0.9, 0.98), fused=True)

    def _stop(self) -> None:
        out = self.settings.out
        kept = f"{out} holds the best weights so far; --start-from goes on from a file"
        raise TrainingStoppedError(f"stopped: {kept if self._is_exported else 'nothing is kept'}")

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
                step=self.step,
                losses=losses,
                validation=validation,
            )
        )

    def _log_losses(self, stage: TrainingStage, losses: dict[str, float], rate: float) -> None:
        if not np.isfinite(list(losses.values())).all():
            raise TrainingError(
                f"the loss is {losses['loss']} at step {self.step}: the training diverged; look "
                "for flights with wrong numbers, or start from other weights"
            )
        self._report(stage.name, losses=losses)
        self._write_log(stage, fraction=self._fraction, **losses, learning_rate=rate)

    def _write_log(self, stage: TrainingStage, **facts: object) -> None:
        record = {"step": self.step, "stage": stage.name, **facts}
        with self._log.open("a") as file:
            file.write(json.dumps(record) + "\n")


def computing_in(device: torch.device, bf16: bool) -> torch.autocast:
    """Return autocast to bfloat16, or a no-op context."""
    return torch.autocast(device.type, torch.bfloat16, enabled=bf16)


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
