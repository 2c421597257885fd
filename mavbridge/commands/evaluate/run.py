"""``mavbridge evaluate`` from its config to its exit status: fly, print, write, draw."""

from collections.abc import Callable, Generator, Mapping
from contextlib import closing

from rich.console import Console
from rich.text import Text

from mavbridge.commands.episode_workers import fly_jobs
from mavbridge.commands.evaluate.config import EvaluateConfig
from mavbridge.commands.evaluate.episodes import (
    EpisodeSpec,
    FlownEpisode,
    fly_on_wall_clock,
    fly_simulated,
)
from mavbridge.commands.evaluate.results import Evaluation, print_evaluation, to_json
from mavbridge.commands.evaluate.resuming import (
    flown_before,
    identity,
    require_same_engine,
    write_whole,
)
from mavbridge.commands.output import progress_bar, require_outputs
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals


def evaluate(config: EvaluateConfig) -> int:
    """Fly every episode of the config; 130 if interrupted, with the results so far.

    Raises:
        MavbridgeError: an episode cannot be flown, or the results cannot be written.
    """
    require_outputs(config.json, config.plot)
    console = Console(stderr=True, emoji=False)
    flown_by = "" if config.json is None else identity(config)
    flown = flown_before(config, flown_by) if config.resume else {}
    failure: MavbridgeError | None = None
    with stop_on_signals() as stop:
        try:
            with closing(_fly(config, console, dict(flown), stop.is_set)) as episodes:
                for index, episode in episodes:
                    if config.resume:
                        require_same_engine(flown, episode.engine)
                    flown[index] = episode
                    _keep(config, flown, flown_by)
        except MavbridgeError as error:
            failure = error  # the episodes flown before still count
        was_stopped = stop.is_set()
    evaluation = _evaluation(config, flown)
    if flown:
        print_evaluation(evaluation, Console())
        if config.plot is not None:
            from mavbridge.commands.evaluate.figure import make_figure

            make_figure(evaluation).savefig(config.plot)
    if config.json is not None and (flown or failure is None):
        config.json.write_text(to_json(evaluation, flown_by))
    if failure is not None or was_stopped:
        ended = f"{'interrupted' if failure is None else 'ended'} after {len(flown)} of "
        console.print(Text(f"{ended}{config.episodes} episodes", style="yellow"))
    if failure is not None:
        raise failure
    return INTERRUPTED if was_stopped else 0


def _keep(config: EvaluateConfig, flown: dict[int, FlownEpisode], flown_by: str) -> None:
    """Write what was flown so far, where that is to be gone on with."""
    if config.resume and config.json is not None:
        write_whole(config.json, to_json(_evaluation(config, flown), flown_by))


def _evaluation(config: EvaluateConfig, flown: dict[int, FlownEpisode]) -> Evaluation:
    episodes = [flown[index] for index in sorted(flown)]
    return Evaluation(
        config=config,
        engine=episodes[0].engine if episodes else "",
        episodes=tuple(one.result for one in episodes),
    )


def _fly(
    config: EvaluateConfig,
    console: Console,
    before: Mapping[int, FlownEpisode],
    should_stop: Callable[[], bool],
) -> Generator[tuple[int, FlownEpisode]]:
    """Fly what was not flown before, until all are flown or ``should_stop``: index and episode."""
    indices = [index for index in range(config.episodes) if index not in before]
    specs = [EpisodeSpec(config=config, index=index) for index in indices]
    done, finished = len(before), sum(one.result.has_finished for one in before.values())
    fly = fly_on_wall_clock if config.is_wall_clock else fly_simulated
    with progress_bar(console) as progress:
        bar = progress.add_task("flying", total=config.episodes, completed=done)
        for at, episode in fly_jobs(fly, specs, config.workers, should_stop):
            for note in () if done > len(before) else episode.notes:
                console.print(Text(note, style="yellow"))
            yield indices[at], episode
            done += 1
            finished += episode.result.has_finished
            progress.update(bar, advance=1, status=f"{finished} of {done} finished")
