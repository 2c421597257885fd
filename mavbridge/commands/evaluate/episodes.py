"""One episode of an evaluation, and its flight on the simulated clock."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from mavbridge.config.courses import HELD_OUT_COURSE_SEED, MAX_EPISODES
from mavbridge.config.evaluate import EvaluateConfig
from mavbridge.core.clock import NS_PER_MS
from mavbridge.flight.policies import load_for_episodes
from mavbridge.simulation.delays import Delays
from mavbridge.simulation.flight import SimulatedFlight, SimulationSettings
from mavbridge.simulation.referee import EpisodeResult
from mavbridge.simulation.world import NOMINAL_VEHICLE, random_vehicle

SCRIPTED = "scripted"


@dataclass(frozen=True, kw_only=True)
class EpisodeSpec:
    """An episode to fly; its seeds follow from the evaluation's seed and its index alone."""

    config: EvaluateConfig
    index: int

    @property
    def seed(self) -> int:
        """Seed of delays and phases; seed S of the evaluation has S * MAX_EPISODES and on."""
        return self.config.policy.seed * MAX_EPISODES + self.index

    @property
    def course_seed(self) -> int:
        """A held-out course."""
        return HELD_OUT_COURSE_SEED + self.seed

    @property
    def conditions_seed(self) -> int | None:
        """The course's, so that no demonstration had these conditions; None = nominal."""
        return self.course_seed if self.config.conditions == "random" else None

    def __str__(self) -> str:
        return f"course {self.course_seed}"


@dataclass(frozen=True, kw_only=True)
class FlownEpisode:
    """An episode's result, and what flew it."""

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
    vision = replace(delays.vision, offset_ns=round(config.vision_delay * NS_PER_MS))
    settings = SimulationSettings(
        rates=config.rates,
        limits=config.limits,
        delays=replace(delays, vision=vision),
        draw_images=config.policy.policy.partition(":")[0] != SCRIPTED,
    )
    conditions_seed = spec.conditions_seed
    flight = SimulatedFlight(
        course_seed=spec.course_seed,
        seed=spec.seed,
        settings=settings,
        vehicle=NOMINAL_VEHICLE if conditions_seed is None else random_vehicle(conditions_seed),
    )
    loaded = load_for_episodes(config.policy, flight.clock)
    result = flight.fly(loaded.executable, max_time_s=config.max_time, should_stop=should_stop)
    return FlownEpisode(engine=loaded.executable.engine, notes=tuple(loaded.notes), result=result)
