"""The whole of ``mavbridge imagine --evaluate``."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from mavbridge.commands.evaluate_imagination.drift import ITERATIONS, DriftScorer
from mavbridge.commands.evaluate_imagination.lens import Lens, Mounting, make_lens
from mavbridge.commands.evaluate_imagination.results import Given, Quality, to_json
from mavbridge.commands.evaluate_imagination.runs import (
    Run,
    Survey,
    chain_steps,
    find_folders,
    read_runs,
    spread,
    survey,
    with_images,
)
from mavbridge.commands.evaluate_imagination.tables import print_quality
from mavbridge.commands.evaluate_imagination.windows import WindowScorer
from mavbridge.commands.imagine.run import SHIPPED, load_model
from mavbridge.commands.imagine.sampling import Sampler
from mavbridge.commands.output import table_console
from mavbridge.config.imagine import ImagineEvaluateConfig
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.files import require_writable
from mavbridge.core.records import ImageArray
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals
from mavbridge.recording.meta import FlightMeta, read_meta
from policy.world_model.config import WorldModelConfig

ShouldStop = Callable[[], bool]
_YAW_RATE = "pilot_yaw_rate_degps"


def evaluate_imagination(flights: Sequence[Path], config: ImagineEvaluateConfig) -> int:
    """Evaluate as the config says; 130 if interrupted, with what there was by then.

    Args:
        flights: flight folders, or folders of them.
        config: the settings.

    Raises:
        MavbridgeError, PolicyError: for whatever a person can have caused.
    """
    require_writable(config.json, "--json")
    cv2.setNumThreads(1)  # images this small are not worth a pool
    model = load_model(config.world_model, ddim_steps=config.ddim_steps, device=config.device)
    sampler = Sampler(model, ddim_steps=config.ddim_steps, decode_all=False, clock=MonotonicClock())
    errors = Console(stderr=True, highlight=False, emoji=False)
    with stop_on_signals() as stop, _Bar(errors) as bar:
        quality = _Evaluation(flights, config, sampler, bar, stop.is_set).quality()
        was_stopped = stop.is_set()
    print_quality(quality, table_console())
    if config.json is not None:
        config.json.write_text(to_json(quality))
    if was_stopped:
        errors.print(Text("interrupted: these are the windows so far", style="yellow"))
    return INTERRUPTED if was_stopped else 0


class _Bar:
    """Progress, one part at a time."""

    def __init__(self, console: Console) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        self._progress = Progress(*columns, TimeRemainingColumn(), console=console)

    def __enter__(self) -> "_Bar":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def begin(self, what: str, total: int) -> Callable[[], None]:
        """What to call after each of them."""
        task = self._progress.add_task(what, total=total)
        return lambda: self._progress.advance(task)


@dataclass(frozen=True, kw_only=True)
class _Flight:
    """One flight that is long enough."""

    survey: Survey
    meta: FlightMeta
    lens: Lens


class _Evaluation:
    """One evaluation, part by part; ends early when somebody says stop."""

    def __init__(
        self,
        paths: Sequence[Path],
        config: ImagineEvaluateConfig,
        sampler: Sampler,
        bar: _Bar,
        should_stop: ShouldStop,
    ) -> None:
        self._config = config
        self._sampler = sampler
        self._model: WorldModelConfig = sampler.config
        self._bar = bar
        self._should_stop = should_stop
        self._exe_steps = config.exe_steps or self._model.frames
        if self._exe_steps > self._model.frames:
            raise UserError(
                f"--exe-steps {self._exe_steps} is more than the {self._model.frames} frames that "
                "the world model imagines: lower it"
            )
        self._folders, self._failed = find_folders(paths)
        self._flights: list[_Flight] = []
        self._too_short = 0

    def quality(self) -> Quality:
        """Everything.

        Raises:
            MavbridgeError, PolicyError: for whatever a person can have caused.
        """
        self._survey()
        windows = WindowScorer(self._sampler, seed=self._config.seed)
        drift = DriftScorer(
            self._sampler,
            seed=self._config.seed,
            exe_steps=self._exe_steps,
            latents=windows.latents,
        )
        if self._flights and not self._should_stop():
            self._score_windows(windows)
            self._score_chains(drift)
        return Quality(
            given=self._given(),
            windows=windows.windows,
            frames=windows.frame_quality(),
            obedience=windows.obedience(),
            own_actions_nearer=windows.own_actions_nearer(),
            drift=drift.iterations(),
        )

    def _survey(self) -> None:
        done = self._bar.begin("reading", len(self._folders))
        mounting = Mounting(
            horizontal_fov_rad=math.radians(self._config.fov),
            tilt_up_rad=math.radians(self._config.camera_tilt),
        )
        for folder in self._folders:
            if self._should_stop():
                return
            found = survey(folder, self._model, exe_steps=self._exe_steps, iterations=ITERATIONS)
            if found is None:
                self._too_short += 1
            else:
                meta = read_meta(folder)
                lens = make_lens(meta, self._model.image_size, mounting)
                self._flights.append(_Flight(survey=found, meta=meta, lens=lens))
            done()
        if not self._flights:
            model = self._model
            raise UserError(
                f"no flight is long enough: {self._too_short} are too short and {self._failed} are "
                f"demonstrations that failed; one of "
                f"{(model.context_frames + model.frames) * model.frame_dt_s:.1f} s with frames at "
                f"{1 / model.frame_dt_s:g} Hz and states at all of them is needed"
            )

    def _score_windows(self, scorer: WindowScorer) -> None:
        rows = spread([flight.survey.windows for flight in self._flights], self._config.windows)
        total = sum(map(len, rows))
        done = self._bar.begin("imagining windows", total)
        runs = [
            read_runs(flight.survey.folder, self._model, self._model.frames, chosen)
            for flight, chosen in zip(self._flights, rows, strict=True)
        ]
        actions = [run.actions for of_flight in runs for run in of_flight]
        index = 0
        for flight, of_flight in zip(self._flights, runs, strict=True):
            for run, images in self._seen(of_flight, scorer.wanted):
                scorer.add(
                    run,
                    images,
                    flight.lens,
                    index=index,
                    yaw_rate_radps=self._yaw_rate_radps(flight.meta),
                    # Of the other half of all windows: of another flight, or of another time.
                    other_actions=actions[(index + total // 2) % total] if total > 1 else None,
                )
                index += 1
                done()

    def _score_chains(self, scorer: DriftScorer) -> None:
        # Only the longest, so that all iterations tell of the same chains.
        iterations = max(flight.survey.chain_iterations for flight in self._flights)
        counts = [f.survey.chains_of(iterations) for f in self._flights]
        rows = spread(counts, self._config.chains)
        done = self._bar.begin("imagining chains", sum(map(len, rows)))
        index = 0
        steps = chain_steps(self._model, self._exe_steps, iterations)
        for flight, chosen in zip(self._flights, rows, strict=True):
            if self._should_stop():
                return
            runs = read_runs(flight.survey.folder, self._model, steps, chosen)
            for run, images in self._seen(runs, scorer.wanted(iterations)):
                scorer.add(run, images, index=index)
                index += 1
                done()

    def _seen(
        self, runs: list[Run], steps: list[int]
    ) -> Iterator[tuple[Run, dict[int, ImageArray]]]:
        """Runs of one flight with their images, until somebody says stop."""
        if self._should_stop():
            return
        for seen in with_images(runs, steps, self._model.image_size):
            yield seen
            if self._should_stop():
                return

    def _yaw_rate_radps(self, meta: FlightMeta) -> float:
        return math.radians(meta.conditions.get(_YAW_RATE, self._config.yaw_rate))

    def _given(self) -> Given:
        metas = [flight.meta for flight in self._flights]
        return Given(
            world_model=str(self._config.world_model or SHIPPED),
            ddim_steps=self._config.ddim_steps,
            seed=self._config.seed,
            frame_dt_s=self._model.frame_dt_s,
            exe_steps=self._exe_steps,
            flights=len(self._flights),
            flights_too_short=self._too_short,
            demonstrations_failed=self._failed,
            flights_with_assumed_lens=sum(not f.lens.is_recorded for f in self._flights),
            flights_with_assumed_yaw_rate=sum(_YAW_RATE not in m.conditions for m in metas),
            asked_windows=self._config.windows,
        )
