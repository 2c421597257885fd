"""One episode of an evaluation as a value, and the flying of it, by whichever worker."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from mavbridge.config.courses import HELD_OUT_COURSE_SEED, MAX_EPISODES
from mavbridge.config.evaluate import EvaluateConfig, Variety
from mavbridge.config.flight import Limits
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_MS
from mavbridge.flight.policies import load_for_episodes
from mavbridge.simulation.delays import Delays, Longer
from mavbridge.simulation.episode import Episode, Setup
from mavbridge.simulation.result import EpisodeResult
from mavbridge.simulation.world import nominal_scene, random_scene
from policy.contract import Executable

SCRIPTED = "scripted"


@dataclass(frozen=True, kw_only=True)
class Job:
    """One episode; its seeds follow from the evaluation's seed and its index alone."""

    index: int
    course_seed: int
    seed: int
    policy: PolicyConfig
    rates: Rates
    limits: Limits
    max_time_s: float
    conditions: Variety
    vision_delay_ns: int

    @property
    def conditions_seed(self) -> int | None:
        """None = the nominal vehicle. The course's: no demonstration had these conditions."""
        return self.course_seed if self.conditions == "random" else None


@dataclass(frozen=True, kw_only=True)
class Flown:
    """What a worker hands back."""

    index: int
    engine: str
    result: EpisodeResult


def make_jobs(config: EvaluateConfig) -> tuple[Job, ...]:
    """All episodes of an evaluation: ``--seed`` S flies the held-out courses S * 10000 and on."""
    first = config.policy.seed * MAX_EPISODES
    return tuple(
        Job(
            index=index,
            course_seed=HELD_OUT_COURSE_SEED + first + index,
            seed=first + index,
            policy=config.policy,
            rates=config.rates,
            limits=config.limits,
            max_time_s=config.max_time,
            conditions=config.conditions,
            vision_delay_ns=round(config.vision_delay * NS_PER_MS),
        )
        for index in range(config.episodes)
    )


def fly_job(job: Job, should_stop: Callable[[], bool] | None = None) -> Flown:
    """Fly one episode in lockstep.

    Raises:
        EpisodeInterruptedError: ``should_stop`` said so.
        MavbridgeError, PolicyError: it cannot be flown.
    """
    is_scripted = job.policy.policy.partition(":")[0] == SCRIPTED
    seed, delays = job.conditions_seed, Delays()
    delays = replace(delays, vision=Longer(than=delays.vision, by_ns=job.vision_delay_ns))
    episode = Episode(
        course_seed=job.course_seed,
        seed=job.seed,
        setup=Setup(rates=job.rates, limits=job.limits, delays=delays, draw_images=not is_scripted),
        build_scene=nominal_scene if seed is None else random_scene(seed),
    )
    executable: Executable = load_for_episodes(job.policy, episode.clock).executable
    result = episode.fly(executable, max_time_s=job.max_time_s, should_stop=should_stop)
    return Flown(index=job.index, engine=executable.engine, result=result)
