"""``mavbridge evaluate``: fly or resume the episodes, print and write the results."""

import hashlib
from collections.abc import Callable, Generator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace

from rich.console import Console
from rich.text import Text

from mavbridge.commands.episode_workers import fly_jobs
from mavbridge.commands.evaluate.results import Evaluation, print_evaluation, to_json
from mavbridge.commands.output import progress_bar
from mavbridge.config.episodes import (
    HELD_OUT_COURSE_SEED,
    MAX_EPISODES,
    EvaluateConfig,
    WorkersConfig,
    first_seed,
)
from mavbridge.config.rates import SOLVES_PER_PLAY
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.files import require_writable, write_durably
from mavbridge.core.provenance import digests, git_revision, versions
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals
from mavbridge.flight.policies import is_scripted, load_for_episodes, policy_files
from mavbridge.flight.settings import contract_with_ages
from mavbridge.simulation.delays import Delay, Delays
from mavbridge.simulation.flight import SimulatedFlight, SimulationSettings
from mavbridge.simulation.referee import EpisodeResult
from mavbridge.simulation.world import (
    draw_conditions,
    make_vehicle,
)
from policy.files import read_json


@dataclass(frozen=True, kw_only=True)
class EpisodeSpec:
    """Episode to fly; its seeds depend only on the evaluation's seed and the episode's index."""

    config: EvaluateConfig
    index: int

    @property
    def seed(self) -> int:
        """Seed of delays and phases; those of evaluation seed S start at S * MAX_EPISODES."""
        return self.config.policy.seed * MAX_EPISODES + self.index

    @property
    def course_seed(self) -> int:
        """Seed of a held-out course."""
        return first_seed(self.config.courses) + HELD_OUT_COURSE_SEED + self.seed

    def __str__(self) -> str:
        return f"course {self.course_seed}"


@dataclass(frozen=True, kw_only=True)
class FlownEpisode:
    """Result of an episode, and the engine that flew it."""

    engine: str
    notes: tuple[str, ...] = ()
    result: EpisodeResult


def fly_simulated(spec: EpisodeSpec, should_stop: Callable[[], bool]) -> FlownEpisode:
    """Fly one episode in lockstep with the simulator.

    Raises:
        EpisodeInterruptedError: ``should_stop`` ended it.
        MavbridgeError: it cannot be flown.
    """
    config, delays = spec.config, Delays()
    vision = delays.vision
    if config.vision_time is not None:
        vision = Delay(p50_ns=round(config.vision_time * NS_PER_MS))
    vision = replace(vision, offset_ns=round(config.vision_delay * NS_PER_MS))
    action = delays.action
    if config.solve_time is not None:
        action = Delay(p50_ns=round(config.solve_time * NS_PER_MS))
    stall_ns = round(config.stalls * NS_PER_MS)
    settings = SimulationSettings(
        rates=config.rates,
        limits=config.limits,
        delays=replace(delays, vision=vision, action=action, stall_ns=stall_ns),
        raw_sticks=config.raw_sticks,
        draw_images=not is_scripted(config.policy),
    )
    conditions = draw_conditions(config.conditions, spec.course_seed)
    if config.gusts is not None:
        conditions = replace(conditions, seed=spec.course_seed, gust_rms_mps=config.gusts)
    flight = SimulatedFlight(
        course_seed=spec.course_seed,
        seed=spec.seed,
        settings=settings,
        vehicle=make_vehicle(autopilot=config.autopilot, gains=config.gains, conditions=conditions),
    )
    with load_for_episodes(config.policy, flight.clock) as loaded:
        contract = contract_with_ages(loaded.runner.contract, config.limits)
        if config.solve_time is not None:
            longest_s = contract.horizon * contract.chunk_dt_s
            play_s = min(SOLVES_PER_PLAY * config.solve_time / 1000, longest_s)
            contract = replace(contract, play_s=max(contract.play_s, play_s))
        if config.state_time is not None:
            contract = replace(contract, state_time=config.state_time)
        runner = replace(loaded.runner, contract=contract)
        result = flight.fly(runner, max_time_s=config.max_time, should_stop=should_stop)
    return FlownEpisode(engine=loaded.runner.engine, notes=tuple(loaded.notes), result=result)


def identity(config: EvaluateConfig) -> str:
    """Return a digest of what determines a flight: flags, contents of policy files, versions.

    The number of flights, their machines and the output are left out. The weights of a policy
    server, and other files that a user's code reads, are unknown here.
    """
    flags = replace(
        config,
        policy=replace(config.policy, checkpoint=None, contract=None),
        episodes=1,
        workers=WorkersConfig(),
        resume=False,
        json=None,
    )
    files = policy_files(config.policy)
    known = digests(files)
    contents = [known.get(str(path.resolve()), str(path)) for path in files]
    parts = (flags, contents, git_revision(), sorted(versions().items()))
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def flown_before(config: EvaluateConfig, flown_by: str) -> dict[int, FlownEpisode]:
    """Return the flights in ``config.json`` by index; none if the file is missing.

    Raises:
        UserError: it holds other data, more flights than requested, or flights of an identity other
            than ``flown_by``.
    """
    path = config.json
    if path is None or not path.exists():
        return {}
    try:
        document = read_json(path)
        held_by, engine = document["flown_by"], str(document["engine"])
        episodes = [
            FlownEpisode(
                engine=engine,
                result=EpisodeResult(**one | {"gate_times_s": tuple(one["gate_times_s"])}),
            )
            for one in document["episodes"]
        ]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"--resume: {path} is no evaluation that can go on ({error!r}): name another --json"
        ) from error
    if held_by != flown_by:
        raise UserError(
            f"--resume: {path} holds flights by other flags, weights or versions: give those, or "
            "name another --json"
        )
    first = config.policy.seed * MAX_EPISODES
    by_index = {episode.result.seed - first: episode for episode in episodes}
    if by_index and max(by_index) >= config.episodes:
        raise UserError(
            f"--resume: {path} holds {len(by_index)} flights: ask for as many --episodes or more"
        )
    return by_index


def require_same_engine(flown: Mapping[int, FlownEpisode], engine: str) -> None:
    """Refuse a flight by an engine other than that of earlier flights.

    Raises:
        UserError: the engine differs, as on another computer.
    """
    if others := {episode.engine for episode in flown.values()} - {engine}:
        raise UserError(
            f"--resume: the flights before were flown by the engine {', '.join(others)}, here it "
            f"is {engine}: go on where they were flown, or name another --json"
        )


def evaluate(config: EvaluateConfig) -> int:
    """Fly every episode of the config; return 130 if interrupted, with the results so far.

    Raises:
        MavbridgeError: an episode cannot be flown, or the results cannot be written.
    """
    require_writable(config.json, "--json")
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
            failure = error  # the episodes flown before that still count
        was_stopped = stop.is_set()
    evaluation = _evaluation(config, flown)
    if flown:
        print_evaluation(evaluation, Console())
    if config.json is not None and (flown or failure is None):
        config.json.write_text(to_json(evaluation, flown_by))
    if failure is not None or was_stopped:
        ended = f"{'interrupted' if failure is None else 'ended'} after {len(flown)} of "
        console.print(Text(f"{ended}{config.episodes} episodes", style="yellow"))
    if failure is not None:
        raise failure
    return INTERRUPTED if was_stopped else 0


def _keep(config: EvaluateConfig, flown: dict[int, FlownEpisode], flown_by: str) -> None:
    """Write the results so far if the evaluation can be resumed."""
    if config.resume and config.json is not None:
        try:
            write_durably(config.json, to_json(_evaluation(config, flown), flown_by))
        except OSError as error:
            reason = error.strerror or error
            raise UserError(f"cannot write --json {config.json}: {reason}") from error


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
    """Fly the missing episodes until ``should_stop``; yield index and episode."""
    indices = [index for index in range(config.episodes) if index not in before]
    specs = [EpisodeSpec(config=config, index=index) for index in indices]
    done, finished = len(before), sum(one.result.has_finished for one in before.values())
    with progress_bar(console) as progress:
        bar = progress.add_task("flying", total=config.episodes, completed=done)
        for at, episode in fly_jobs(fly_simulated, specs, config.workers, should_stop):
            for note in () if done > len(before) else episode.notes:
                console.print(Text(note, style="yellow"))
            yield indices[at], episode
            done += 1
            finished += episode.result.has_finished
            progress.update(bar, advance=1, status=f"{finished} of {done} finished")
