"""The whole evaluation: fly, count, print, write, draw."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from mavbridge.commands.evaluate.cluster import fly_on_ray
from mavbridge.commands.evaluate.jobs import Flown, Job, fly_job, make_jobs
from mavbridge.commands.evaluate.realtime import fly_realtime
from mavbridge.commands.evaluate.results import Evaluation, to_json
from mavbridge.commands.evaluate.tables import print_evaluation
from mavbridge.commands.output import require_matplotlib
from mavbridge.config.evaluate import EvaluateConfig
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals
from mavbridge.flight.policies import load_for_episodes
from mavbridge.simulation.referee import EpisodeInterruptedError
from policy.errors import PolicyError


def evaluate(config: EvaluateConfig) -> int:
    """Fly all that the config asks for; 130 if interrupted, with the results so far.

    Raises:
        MavbridgeError, PolicyError: for whatever a person can have caused.
    """
    # Refused now, not after an hour.
    draw = None if config.plot is None else _drawing(config.plot)
    for path in (config.json, config.plot):
        if path is not None:
            _require_writable(path)
    console = Console(stderr=True, emoji=False)
    flown: list[Flown] = []
    failure: MavbridgeError | PolicyError | None = None
    with stop_on_signals() as stop:
        try:
            _fly(config, console, flown, stop.is_set)
        except (MavbridgeError, PolicyError) as error:
            failure = error  # what was flown before is not lost by it
        was_stopped = stop.is_set()
    if flown or failure is None:
        _tell(_evaluation(config, flown), config, draw)
    if failure is not None or was_stopped:
        ended = f"{'interrupted' if failure is None else 'ended'} after {len(flown)} of "
        console.print(Text(f"{ended}{config.episodes} episodes", style="yellow"))
    if failure is not None:
        raise failure
    return INTERRUPTED if was_stopped else 0


def _tell(
    evaluation: Evaluation, config: EvaluateConfig, draw: Callable[[Evaluation], None] | None
) -> None:
    """Print, draw and write."""
    if evaluation.episodes:
        print_evaluation(evaluation, Console())
        if draw is not None:
            draw(evaluation)
    if config.json is not None:
        config.json.write_text(to_json(evaluation))


def _fly(
    config: EvaluateConfig,
    console: Console,
    flown: list[Flown],
    should_stop: Callable[[], bool],
) -> None:
    """Every episode, until somebody says stop; an error ends it, too. Adds to ``flown``."""
    progress = Progress(
        TextColumn("flying"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[score]}"),
        TimeRemainingColumn(),
        console=console,
    )
    with progress:
        bar = progress.add_task("flying", total=config.episodes, score="")
        for one in _episodes(config, console, should_stop):
            flown.append(one)
            finished = sum(other.result.has_finished for other in flown)
            progress.update(bar, advance=1, score=f"{finished} of {len(flown)} finished")


def _evaluation(config: EvaluateConfig, flown: list[Flown]) -> Evaluation:
    flown.sort(key=lambda one: one.index)
    return Evaluation(
        policy=config.policy.policy,
        engine=flown[0].engine if flown else "",
        mode="realtime" if config.realtime else "lockstep",
        conditions=config.conditions,
        vision_delay_ms=config.vision_delay,
        seed=config.policy.seed,
        asked_episodes=config.episodes,
        episodes=tuple(one.result for one in flown),
    )


def _episodes(
    config: EvaluateConfig, console: Console, should_stop: Callable[[], bool]
) -> Iterable[Flown]:
    """Results as they come, in any order; ends early when somebody says stop."""
    jobs = make_jobs(config)
    if config.realtime:
        return fly_realtime(jobs, should_stop=should_stop)
    if config.workers > 1 or config.ray is not None:
        return fly_on_ray(jobs, workers=config.workers, address=config.ray, should_stop=should_stop)
    for note in load_for_episodes(config.policy, MonotonicClock()).notes:
        console.print(Text(note, style="yellow"))
    return _one_by_one(jobs, should_stop)


def _one_by_one(jobs: Iterable[Job], should_stop: Callable[[], bool]) -> Iterator[Flown]:
    with suppress(EpisodeInterruptedError):
        for job in jobs:
            yield fly_job(job, should_stop)


def _drawing(path: Path) -> Callable[[Evaluation], None]:
    """What draws the figure to ``path``; looked for before the run."""
    require_matplotlib()
    from mavbridge.commands.evaluate.figure import draw

    return lambda evaluation: draw(evaluation, path)


def _require_writable(path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        was_there = path.exists()
        path.open("ab").close()
        if not was_there:
            path.unlink()
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error
