"""``mavbridge evaluate-imagination``: from flights to figures."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
from rich.console import Console
from rich.progress import Progress
from rich.text import Text

from mavbridge.commands.evaluate_imagination.flights import (
    choose_windows,
    read_episode,
    with_images,
)
from mavbridge.commands.evaluate_imagination.results import (
    DriftIteration,
    Given,
    ImaginationQuality,
    print_quality,
    to_json,
)
from mavbridge.commands.evaluate_imagination.scores import DriftScorer, WindowScorer
from mavbridge.commands.imagine.config import EvaluateImaginationConfig
from mavbridge.commands.imagine.run import SHIPPED, load_model
from mavbridge.commands.imagine.sampling import Sampler
from mavbridge.commands.output import progress_bar, table_console
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.files import require_writable
from mavbridge.core.stopping import INTERRUPTED, StopRequest, stop_on_signals
from policy.data.flight_data import FlightData
from policy.data.flight_folders import failure_of, find_flights
from policy.world_model.config import WorldModelConfig

ITERATIONS = 10
"""Iterations of a chain, if a flight is long enough."""
_T = TypeVar("_T")


def evaluate_imagination(flights: Sequence[Path], config: EvaluateImaginationConfig) -> int:
    """Evaluate a world model on flight folders, or folders of them; 130 if interrupted."""
    require_writable(config.json, "--json")
    cv2.setNumThreads(1)  # images this small are not worth a pool
    model = load_model(config.world_model, ddim_steps=config.ddim_steps, device=config.device)
    sampler = Sampler(model, ddim_steps=config.ddim_steps, decode_all=False, clock=MonotonicClock())
    exe_steps = config.exe_steps or model.config.frames
    if exe_steps > model.config.frames:
        raise UserError(
            f"--exe-steps {exe_steps} is more than the {model.config.frames} frames that the world "
            "model imagines: lower it"
        )
    errors = Console(stderr=True, highlight=False, emoji=False)
    with stop_on_signals() as stop, progress_bar(errors) as progress:
        quality = _Evaluation(config, sampler, exe_steps, progress, stop).run(flights)
        was_stopped = stop.is_set()
    print_quality(quality, table_console())
    if config.json is not None:
        config.json.write_text(to_json(quality))
    if was_stopped:
        errors.print(Text("interrupted: these are the windows so far", style="yellow"))
    return INTERRUPTED if was_stopped else 0


@dataclass(frozen=True)
class _Evaluation:
    config: EvaluateImaginationConfig
    sampler: Sampler
    exe_steps: int
    progress: Progress
    stop: StopRequest

    @property
    def model(self) -> WorldModelConfig:
        return self.sampler.config

    def run(self, paths: Sequence[Path]) -> ImaginationQuality:
        """Read, imagine and score everything."""
        config, model = self.config, self.model
        folders = find_flights(paths)
        exemplary = [folder for folder in folders if failure_of(folder) is None]
        reading = self._until_stopped(exemplary, "reading", len(exemplary))
        episodes = [read_episode(folder, model) for folder in reading]
        scorer, flights = self._score_windows(episodes)
        too_short, failed = len(episodes) - flights, len(folders) - len(exemplary)
        if flights == 0 and not self.stop.is_set():
            raise UserError(
                f"no flight is long enough: {too_short} are too short and {failed} are "
                f"demonstrations that failed; one of "
                f"{(model.context_frames + model.frames) * model.frame_dt_s:.1f} s with frames at "
                f"{1 / model.frame_dt_s:g} Hz and states at all of them is needed"
            )
        return ImaginationQuality(
            given=Given(
                world_model=str(config.world_model or SHIPPED),
                ddim_steps=config.ddim_steps,
                seed=config.seed,
                frame_dt_s=model.frame_dt_s,
                exe_steps=self.exe_steps,
                flights=flights,
                flights_too_short=too_short,
                demonstrations_failed=failed,
                asked_windows=config.windows,
                damage=tuple(text for episode in episodes for text in episode.damage),
            ),
            windows=scorer.windows,
            frames=scorer.frame_quality(),
            stick_following=scorer.stick_following(),
            own_actions_nearer=scorer.own_actions_nearer(),
            drift=self._score_chains(episodes),
        )

    def _score_windows(self, episodes: list[FlightData]) -> tuple[WindowScorer, int]:
        """The scores, and how many flights have windows."""
        scorer = WindowScorer(self.sampler, seed=self.config.seed)
        windows, flights = choose_windows(
            episodes, self.model, steps=self.model.frames, count=self.config.windows
        )
        count = len(windows)
        seen = with_images(windows, scorer.image_steps, self.model.image_size)
        imagining = self._until_stopped(seen, "imagining windows", count)
        for index, (window, images) in enumerate(imagining):
            # Half of all windows away: of another flight, or of another time.
            other = windows[(index + count // 2) % count].actions if count > 1 else None
            scorer.add(window, images, index=index, other_actions=other)
        return scorer, flights

    def _score_chains(self, episodes: list[FlightData]) -> tuple[DriftIteration, ...]:
        """Score the longest chains that any flight has room for: all iterations compare."""
        for iterations in range(ITERATIONS, 0, -1):
            steps = (iterations - 1) * self.exe_steps + self.model.frames
            windows, _ = choose_windows(episodes, self.model, steps=steps, count=self.config.chains)
            if windows:
                break
        scorer = DriftScorer(
            self.sampler,
            seed=self.config.seed,
            exe_steps=self.exe_steps,
            iterations=iterations,
        )
        seen = with_images(windows, scorer.image_steps, self.model.image_size)
        chains = self._until_stopped(seen, "imagining chains", len(windows))
        for index, (window, images) in enumerate(chains):
            scorer.add(window, images, index=index)
        return scorer.iterations()

    def _until_stopped(self, items: Iterable[_T], what: str, total: int) -> Iterator[_T]:
        task = self.progress.add_task(what, total=total)
        for item in items:
            if self.stop.is_set():
                return
            yield item
            self.progress.advance(task)
