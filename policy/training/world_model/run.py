"""Train a world model from flights: the autoencoder, then the dynamics on kept latents.

flights -> Episodes -> FrameStore (decoded once) -> autoencoder
                   `-> windows, and latents (encoded once) -> dynamics -> EMA, best on held-out
"""

import json
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from policy.checkpoints.world_model_file import load_world_model, save_world_model
from policy.data.episodes import DatasetError, Episode, common_frame, hold_out
from policy.data.frames import store_frames
from policy.data.interpolation import Indices
from policy.data.windows import Windows, find_windows
from policy.errors import PolicyError
from policy.training.batches import PooledStore
from policy.training.encode import both_ways, encode_rows
from policy.training.loop import Loop, open_run
from policy.training.parallel import computing_in
from policy.training.plan import WorldTrainSettings
from policy.training.report import Report, TrainResult, WorldValidation
from policy.training.state import RunFolder
from policy.training.world_model.batches import FrameBatch, WindowBatches, frame_batch, read_frames
from policy.training.world_model.losses import (
    autoencoder_loss,
    dynamics_loss,
    set_scales,
    validate_autoencoder,
    validate_world_model,
)
from policy.world_model.autoencoder import to_unit
from policy.world_model.model import WorldModel

AUTOENCODER, DYNAMICS = 0, 1
"""Stages, in the order of ``WorldTrainSettings.stages``."""
VALIDATION_FRAMES = 128
VALIDATION_WINDOWS = 128
IMAGINED_WINDOWS = 16
"""Of them, those that are imagined frame by frame."""


def train_world_model(
    episodes: Sequence[Episode],
    settings: WorldTrainSettings,
    *,
    now_s: Callable[[], float],
    report: Report,
    should_stop: Callable[[], bool] = lambda: False,
) -> TrainResult:
    """Train, and write the best weights on held-out flights to ``settings.out``.

    Args:
        episodes: the flights.
        settings: what to train and how long.
        now_s: monotonic seconds, for a budget in time.
        report: called with progress, losses and notes.
        should_stop: asked after every step; True ends the run, to be resumed.

    Raises:
        DatasetError: flights that cannot be learned from.
        TrainingError: a run that cannot be resumed, kept, or that diverged.
        TrainingStoppedError: ``should_stop`` said so.
        PolicyError: an autoencoder to keep that does not fit.
    """
    folder = open_run(settings, episodes)
    if (frame := common_frame(list(episodes))) != settings.model.contract.state_frame:
        raise DatasetError(
            f"the flights hold {frame} states, the world model is to take "
            f"{settings.model.contract.state_frame}"
        )
    return _Run(list(episodes), settings, folder, now_s, report, should_stop).finish()


class _Run:
    """One run, from its first step or from where it was killed."""

    def __init__(
        self,
        episodes: list[Episode],
        settings: WorldTrainSettings,
        folder: RunFolder,
        now_s: Callable[[], float],
        report: Report,
        should_stop: Callable[[], bool],
    ) -> None:
        self._settings, self._folder, self._model = settings, folder, settings.model
        trainee = _new_model(settings)
        _learn(trainee, AUTOENCODER)
        self._loop = Loop(
            trainee,
            settings,
            folder,
            learning_rate=settings.learning_rate,
            now_s=now_s,
            report=report,
            should_stop=should_stop,
        )
        self._load(episodes)
        self._latents: PooledStore | None = None
        if settings.resume:
            self._loop.restore(lambda position: _learn(trainee, position.stage))
        else:
            folder.start_log()

    def finish(self) -> TrainResult:
        """All stages that are left; then the files of the run are removed."""
        position = self._loop.position
        for stage in range(position.stage, len(self._settings.stages)):
            is_new = stage != position.stage
            position.stage = stage
            if stage == AUTOENCODER:
                self._train_autoencoder()
            else:
                self._train_dynamics(self._encode(is_new=is_new))
        self._folder.clear()
        return TrainResult(
            checkpoint=self._settings.out,
            steps=position.step,
            validation=None if position.kept is None else WorldValidation(**position.kept),
            score=None,
        )

    # ---- flights ----

    def _load(self, episodes: list[Episode]) -> None:
        """Decode; frames and windows of the flights to train on and of those held out."""
        size, settings, loop = self._model.image_size, self._settings, self._loop
        self._store = store_frames(
            episodes,
            height=size,
            width=size,
            folder=self._folder.frames,
            progress=lambda fraction: loop.doing(f"decoding, {fraction:.0%}"),
        )
        counts = self._store.counts
        episodes = [e.first_frames(n) for e, n in zip(episodes, counts, strict=True)]
        windows = find_windows(
            episodes,
            context_frames=self._model.context_frames,
            frames=self._model.frames,
            frame_dt_s=self._model.frame_dt_s,
        )
        kept, held = hold_out(episodes, settings.validation_fraction, settings.seed)
        flight_of = np.repeat(np.arange(len(counts)), counts)
        self._frames, self._held_frames = (
            np.flatnonzero(np.isin(flight_of, flights)) for flights in (kept, held)
        )
        self._windows = windows.among(self._frames)
        self._held = windows.among(self._held_frames).spread(VALIDATION_WINDOWS)
        self._flights = len(kept)
        if len(self._windows) == 0:
            raise DatasetError("only flights that are held out are long enough: add more flights")
        if len(self._held) == 0:
            loop.note("no flight is held out: the last weights will be kept, not the best")

    # ---- the autoencoder ----

    def _train_autoencoder(self) -> None:
        loop, settings, stage = self._loop, self._settings, self._settings.stages[AUTOENCODER]

        def make(step: int) -> FrameBatch:
            return frame_batch(
                self._store,
                self._windows,
                self._model,
                step,
                count=settings.batch_size // 2,
                seed=settings.seed,
                mirrors=settings.mirror,
            )

        def look_back() -> None:
            validation = None
            if len(self._held_frames):
                count = min(VALIDATION_FRAMES, len(self._held_frames))
                rows = np.linspace(0, len(self._held_frames) - 1, count).astype(np.int64)
                images = self._images(self._held_frames[rows], is_mirrored=False)
                validation = validate_autoencoder(loop.average, images)
                loop.tell(stage, validation)
            loop.offer(None, validation, self._export, is_last=False)

        loop.run(
            stage,
            stage.end,
            mode=WorldModel.train,
            make=make,
            losses=autoencoder_loss,
            look_back=look_back,
        )

    def _encode(self, *, is_new: bool) -> PooledStore:
        """Freeze the average autoencoder and encode all frames; a resumed run has its weights."""
        loop, settings, stage = self._loop, self._settings, self._settings.stages[DYNAMICS]
        if is_new:
            loop.trainee.load_state_dict(loop.average.state_dict())
        go_on = loop.encoding_in(stage)

        @torch.no_grad()
        def encode(frames: Indices, is_mirrored: bool) -> Tensor:
            images = to_unit(self._images(frames, is_mirrored=is_mirrored))
            with computing_in(loop.device, loop.bf16):
                return loop.average.autoencoder.posterior(images)[0].flatten(1)

        # Those of the validation first: without them no weights could be chosen.
        held, kept = np.unique(self._held.frames), np.unique(self._windows.frames)
        latents = encode_rows(
            self._folder.pooled,
            both_ways(np.concatenate([held, kept]), mirror=settings.mirror),
            encode,
            dim=self._model.latent_channels * self._model.latent_side**2,
            go_on=go_on,
        )
        total = len(self._windows)
        self._held, self._windows = (w.among(latents.frames) for w in (self._held, self._windows))
        if len(self._windows) == 0:
            raise DatasetError("there was no time to encode one window: give more --minutes")
        if len(self._windows) < total:
            loop.note(
                f"{total - len(self._windows)} windows were not encoded for lack of time: the "
                "dynamics sees the rest"
            )
        if is_new:
            set_scales(loop.trainee, self._windows, latents, mirrors=settings.mirror)
            loop.average.load_state_dict(loop.trainee.state_dict())
            _learn(loop.trainee, DYNAMICS)
            loop.begin_phase(settings.learning_rate)
        return latents

    # ---- the dynamics ----

    def _train_dynamics(self, latents: PooledStore) -> None:
        loop, settings, stage = self._loop, self._settings, self._settings.stages[DYNAMICS]
        batches, held = (self._batches(windows, latents) for windows in (self._windows, self._held))
        validation_batches = held.validation(IMAGINED_WINDOWS) if len(self._held) else []
        moved = [batch.to(loop.device) for batch in validation_batches]
        seen = self._frames_of_first(len(validation_batches))

        def look_back(*, is_last: bool = False) -> None:
            validation = None
            if moved:
                with computing_in(loop.device, loop.bf16):
                    validation = validate_world_model(loop.average, moved, seen)
                loop.tell(stage, validation)
            score = None if validation is None else -validation.loss
            loop.offer(score, validation, self._export, is_last=is_last)

        loop.run(
            stage,
            stage.end,
            mode=WorldModel.train,
            make=lambda step: batches.batch(step, settings.window_batch_size),
            losses=dynamics_loss,
            look_back=look_back,
        )
        look_back(is_last=True)

    def _batches(self, windows: Windows, latents: PooledStore) -> WindowBatches:
        return WindowBatches(
            windows,
            latents,
            self._model,
            seed=self._settings.seed,
            mirrors=self._settings.mirror,
            decision_share=self._settings.decision_share,
        )

    def _frames_of_first(self, parts: int) -> Tensor:
        """What was seen [B, K + T, H, W, 3] in the first of so many batches of validation."""
        frames = self._held.frames[:: max(parts, 1)]
        images = self._images(frames.ravel(), is_mirrored=False)
        return images.reshape(*frames.shape, *images.shape[1:])

    # ---- pictures and files ----

    def _images(self, frames: Indices, *, is_mirrored: bool) -> Tensor:
        images = read_frames(self._store, frames, self._model.image_size, is_mirrored=is_mirrored)
        return images.to(self._loop.device)

    def _export(self) -> None:
        position, settings = self._loop.position, self._settings
        card = {
            "flights": self._flights,
            "images": len(self._frames),
            "windows": len(self._windows),
            "steps": position.step,
            "batch_size": settings.batch_size,
            "window_batch_size": settings.window_batch_size,
            "seed": settings.seed,
            "mirror": settings.mirror,
            "decision_share": settings.decision_share,
            "autoencoder": "trained" if settings.autoencoder_of is None else "kept",
            "validation": position.kept,
        }
        training = json.dumps(card, sort_keys=True)
        save_world_model(settings.out, self._loop.average, training=training)


def _new_model(settings: WorldTrainSettings) -> WorldModel:
    """Random weights of the seed, but for an autoencoder that is kept.

    The process's random stream stays as it was.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        model = WorldModel(settings.model)
    if (path := settings.autoencoder_of) is not None:
        kept = load_world_model(path)
        for name in ("image_size", "latent_channels", "autoencoder_widths"):
            its, ours = (getattr(config, name) for config in (kept.config, settings.model))
            if its != ours:
                raise PolicyError(
                    f"--start-from {path}: its autoencoder has {name} {its}, this model {ours}: "
                    "ask for the same, or leave out --start-from"
                )
        model.autoencoder.load_state_dict(kept.autoencoder.state_dict())
    return model.to(settings.device)


def _learn(model: WorldModel, stage: int) -> None:
    """Only what is trained in a stage may move."""
    model.requires_grad_(stage == DYNAMICS)
    model.autoencoder.requires_grad_(stage == AUTOENCODER)
