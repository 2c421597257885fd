"""``mavbridge evaluate``: fly or resume the episodes, print and write the results with 95 %
intervals."""

import hashlib
import math
import statistics
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, is_dataclass, replace

from rich.console import Console

from mavbridge.commands.episode_workers import fly_jobs
from mavbridge.commands.output import make_table, progress_bar, text_console, write_json
from mavbridge.config.episodes import (
    COURSE_SEEDS,
    HELD_OUT_COURSE_SEED,
    MAX_EPISODES,
    EvaluateConfig,
    WorkersConfig,
)
from mavbridge.config.flight import FlyConfig
from mavbridge.config.policy import SOLVES_PER_PLAY
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.files import from_json, require_writable
from mavbridge.core.provenance import digests, git_revision, versions
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals
from mavbridge.flight.policies import is_scripted, load_for_episodes, policy_files
from mavbridge.flight.settings import contract_with_ages
from mavbridge.simulation.delays import Delay, Delays
from mavbridge.simulation.flight import SimulatedFlight, SimulationSettings
from mavbridge.simulation.referee import EpisodeResult
from mavbridge.simulation.world import DRAWN_CONDITIONS, make_vehicle
from policy.contract import LEAST
from policy.files import read_json

Z95 = 1.959963984540054
"""95 % of a normal distribution are within this many standard deviations."""
T95 = (12.706, 4.303)
"""The same of Student's t with one and two degrees of freedom."""


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
        return COURSE_SEEDS[self.config.courses] + HELD_OUT_COURSE_SEED + self.seed

    def __str__(self) -> str:
        return f"course {self.course_seed}"


@dataclass(frozen=True, kw_only=True)
class FlownEpisode:
    """Result of an episode, and the engine that flew it."""

    engine: str
    notes: tuple[str, ...] = ()
    result: EpisodeResult


def fly_simulated(spec: EpisodeSpec, should_stop: Callable[[], bool]) -> FlownEpisode:
    """Fly one episode in lockstep with the simulator. See ``FlyJob``."""
    config, usual = spec.config, Delays()
    vision = _delay(usual.vision, config.vision_time)
    delays = replace(
        usual,
        vision=replace(vision, offset_ns=round(config.vision_delay * NS_PER_MS)),
        action=_delay(usual.action, config.solve_time),
        stall_ns=round(config.stalls * NS_PER_MS),
    )
    settings = SimulationSettings(
        config=FlyConfig(rates=config.rates, limits=config.limits),
        delays=delays,
        draw_images=not is_scripted(config.policy),
    )
    conditions = DRAWN_CONDITIONS[config.conditions](spec.course_seed)
    if config.gusts is not None:
        conditions = replace(conditions, seed=spec.course_seed, gust_rms_mps=config.gusts)
    flight = SimulatedFlight(
        course_seed=spec.course_seed,
        seed=spec.seed,
        laps=config.laps,
        settings=settings,
        vehicle=make_vehicle(autopilot=config.autopilot, gains=config.gains, conditions=conditions),
    )
    with load_for_episodes(config.policy, flight.clock, spec.seed) as loaded:
        contract = contract_with_ages(loaded.runner.contract, config.limits)
        if config.solve_time is not None:
            longest_s = contract.horizon * contract.chunk_dt_s
            play_s = min(SOLVES_PER_PLAY * config.solve_time / 1000, longest_s)
            if play_s >= LEAST:  # else as good as at once
                contract = replace(contract, play_s=max(contract.play_s, play_s))
        if config.state_time is not None:
            contract = replace(contract, state_time=config.state_time)
        runner = replace(loaded.runner, contract=contract)
        result = flight.fly(
            runner, max_time_s=config.max_time, run_out_s=config.hover, should_stop=should_stop
        )
    return FlownEpisode(engine=loaded.runner.engine, notes=tuple(loaded.notes), result=result)


def _delay(usual: Delay, asked_ms: float | None) -> Delay:
    return usual if asked_ms is None else Delay(p50_ns=round(asked_ms * NS_PER_MS))


def identity(config: EvaluateConfig) -> str:
    """Return a digest of what determines a flight: flags, contents of policy files, versions.

    The number of flights, their machines and the output are left out. The weights of a policy
    server, and other files that a user's code reads, are unknown here.
    """
    policy = replace(config.policy, checkpoint=None, contract=None)
    flags = replace(_flags(config), policy=policy, episodes=1)
    files = policy_files(config.policy)
    known = digests(files)
    contents = [known.get(str(path.resolve()), str(path)) for path in files]
    parts = (flags, contents, git_revision(), sorted(versions().items()))
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _flags(config: EvaluateConfig) -> EvaluateConfig:
    """Return the flags that may change a result, the others as by default."""
    return replace(config, workers=WorkersConfig(), resume=False, json=None)


def flown_before(config: EvaluateConfig, flown_by: str) -> dict[int, FlownEpisode]:
    """Return the flights in ``config.json`` by index; none if the file is missing.

    Raises UserError unless they are of the identity ``flown_by``, and among those requested.
    """
    path = config.json
    if path is None or not path.exists():
        return {}
    try:
        document = read_json(path)
        held_by, engine = document["flown_by"], str(document["engine"])
        flown = [from_json(EpisodeResult, one) for one in document["episodes"]]
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
    by_index = {one.seed - first: FlownEpisode(engine=engine, result=one) for one in flown}
    if by_index and max(by_index) >= config.episodes:
        raise UserError(
            f"--resume: {path} holds {len(by_index)} flights: ask for as many --episodes or more"
        )
    return by_index


def evaluate(config: EvaluateConfig) -> int:
    """Fly every episode of the config; return 130 if interrupted, with the results so far."""
    require_writable(config.json, "--json")
    console = text_console(stderr=True)
    flown_by = "" if config.json is None else identity(config)
    flown = flown_before(config, flown_by) if config.resume else {}
    failure: MavbridgeError | None = None
    with stop_on_signals() as stop:
        try:
            with closing(_fly(config, console, dict(flown), stop.is_set)) as episodes:
                for index, episode in episodes:
                    flown[index] = episode
                    if config.resume:
                        write_json(config.json, as_document(config, flown, flown_by))
        except MavbridgeError as error:
            failure = error  # the episodes flown before that still count
        except KeyboardInterrupt:  # the second request: the policy hangs
            stop.set()
        if flown or failure is None:
            write_json(config.json, as_document(config, flown, flown_by))
        was_stopped = stop.is_set()
    if flown:
        print_evaluation(config, flown, text_console())
    if failure is not None or was_stopped:
        ended = f"{'interrupted' if failure is None else 'ended'} after {len(flown)} of "
        console.print(f"{ended}{config.episodes} episodes", style="yellow")
    if failure is not None:
        raise failure
    return INTERRUPTED if was_stopped else 0


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
        bar = progress.add_task("flying", total=config.episodes, completed=done, status="")
        for at, episode in fly_jobs(fly_simulated, specs, config.workers, should_stop):
            for note in () if done > len(before) else episode.notes:
                console.print(note, style="yellow")
            yield indices[at], episode
            done += 1
            finished += episode.result.has_finished
            progress.update(bar, advance=1, status=f"{finished} of {done} finished")


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Mean or rate; the interval is None if a single flight gives none."""

    value: float
    low: float | None
    high: float | None
    count: int


def rate(successes: int, count: int) -> Estimate:
    """Return the success rate with Wilson's score interval (E. B. Wilson 1927, JASA 22, 209)."""
    share, z2 = successes / count, Z95**2
    centre = (share + z2 / (2 * count)) / (1 + z2 / count)
    spread = math.sqrt(share * (1 - share) / count + z2 / (4 * count**2))
    half = Z95 * spread / (1 + z2 / count)
    # Rounding may leave the share itself out: a rate of 0 had a lower limit of 6e-17.
    low, high = min(max(centre - half, 0.0), share), max(min(centre + half, 1.0), share)
    return Estimate(value=share, low=low, high=high, count=count)


def mean(values: Sequence[float]) -> Estimate | None:
    """Return the mean with its interval by Student's t; None without values."""
    if not values:
        return None
    value, low, high = statistics.fmean(values), None, None
    if len(values) > 1:
        half = _t95(len(values) - 1) * statistics.stdev(values) / math.sqrt(len(values))
        low, high = value - half, value + half
    return Estimate(value=value, low=low, high=high, count=len(values))


def _t95(freedom: int) -> float:
    """Return Student's t at 97.5 %, within 1 % (Abramowitz and Stegun 1964, 26.7.5)."""
    if freedom <= len(T95):
        return T95[freedom - 1]
    z, n = Z95, freedom
    second, third = 5 * z**5 + 16 * z**3 + 3 * z, 3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z
    return z + (z**3 + z) / (4 * n) + second / (96 * n**2) + third / (384 * n**3)


FIGURES = {
    "gates_passed": "gates passed",
    "mean_speed_mps": "mean speed, m/s",
    "course_speed_mps": "speed from gate to gate, m/s",
    "stick_rate_per_s": "change of actions, 1/s",
    "flown_s": "flown, s",
    "course_s": "course time, s (successful flights)",
    "drift_m": "drift after the stop, m",
}
"""Fields of an ``EpisodeResult`` of which the mean is shown, and their names in the table."""


def summarise(episodes: Sequence[EpisodeResult]) -> dict[str, Estimate | None]:
    """Return the success rate and the means of one or more episodes; None: no episode has one."""
    summary: dict[str, Estimate | None] = {
        "success_rate": rate(sum(one.has_finished for one in episodes), len(episodes))
    }
    for name in FIGURES:
        values = [getattr(one, name) for one in episodes]
        summary[name] = mean([value for value in values if value is not None])
    return summary


def _outcomes(episodes: Sequence[EpisodeResult]) -> dict[str, int]:
    return dict(Counter(one.outcome for one in episodes).most_common())


def as_document(
    config: EvaluateConfig, flown: Mapping[int, FlownEpisode], flown_by: str
) -> dict[str, object]:
    """Return all results for ``--json``; the summary is null without episodes, ``flown_by`` from
    ``identity``."""
    episodes = _results(flown)
    summary: dict[str, object] | None = None
    if episodes:
        summary = {**summarise(episodes), "outcomes": _outcomes(episodes)}
    return {
        "flags": _flags(config),
        "engine": _engine(flown),
        "flown_by": flown_by,
        "summary": summary,
        "episodes": episodes,
    }


def print_evaluation(
    config: EvaluateConfig, flown: Mapping[int, FlownEpisode], console: Console
) -> None:
    """Print each figure with its 95 % interval, then how the flights ended."""
    episodes = _results(flown)
    summary = summarise(episodes)
    rows = [("success rate", *_cells(summary["success_rate"], "{:.1%}"))]
    for name, shown in FIGURES.items():
        label = f"{shown}, of {episodes[0].gates_total}" if name == "gates_passed" else shown
        rows.append((label, *_cells(summary[name], "{:.2f}")))
    title = [f"{config.policy.policy} ({_engine(flown)})"]
    flags, usual = _flags(config), EvaluateConfig(policy=config.policy, episodes=config.episodes)
    changed = {n: getattr(config.policy, n) for n in config.policy.given("policy")}
    changed |= {n: value for n, value in vars(flags).items() if value != getattr(usual, n)}
    title += [
        f"{name.replace('_', ' ')} {value}"
        for name, value in changed.items()
        if not is_dataclass(value)
    ]
    header = ("", "mean", "95 % interval", "flights")
    console.print(make_table(", ".join(title), header, rows))
    ends = ", ".join(f"{count} {outcome}" for outcome, count in _outcomes(episodes).items())
    console.print(f"{len(episodes)} flights: {ends}")
    reasons = [one.lost for one in episodes if one.lost is not None]
    for code, count in Counter(reason.code for reason in reasons).most_common():
        first = next(reason for reason in reasons if reason.code is code)
        console.print(f"the policy lost control in {count}: {first}", style="yellow")


def _results(flown: Mapping[int, FlownEpisode]) -> list[EpisodeResult]:
    return [flown[index].result for index in sorted(flown)]


def _engine(flown: Mapping[int, FlownEpisode]) -> str:
    """Return the engine of the flights; empty if there are none."""
    return flown[min(flown)].engine if flown else ""


def _cells(estimate: Estimate | None, form: str) -> tuple[str, str, str]:
    if estimate is None:
        return "-", "-", "0"
    interval = "-"
    if estimate.low is not None and estimate.high is not None:
        interval = f"{form.format(estimate.low)} to {form.format(estimate.high)}"
    return form.format(estimate.value), interval, str(estimate.count)
