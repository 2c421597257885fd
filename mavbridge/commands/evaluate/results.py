"""What an evaluation found: frozen values, and their JSON."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from mavbridge.commands.evaluate.statistics import Estimate, mean, rate
from mavbridge.config.evaluate import Variety
from mavbridge.simulation.result import EpisodeResult, Outcome


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Over all episodes unless said otherwise; None = no episode that could tell."""

    success_rate: Estimate
    """All gates in order, no crash."""
    gates_passed: Estimate | None
    mean_speed_mps: Estimate | None
    """Path over time, take-off included."""
    stick_rate_per_s: Estimate | None
    """Mean |change| of a stick per second: lower is smoother."""
    flown_s: Estimate | None
    course_s: Estimate | None
    """First action to last gate, of the successful flights."""
    outcomes: tuple[tuple[Outcome, int], ...]
    """Most frequent first."""


def summarise(episodes: Sequence[EpisodeResult]) -> Summary:
    """The figures of one or more episodes.

    Raises:
        ValueError: there are none.
    """
    sticks = [one.stick_rate_per_s for one in episodes if one.stick_rate_per_s is not None]
    return Summary(
        success_rate=rate(sum(one.has_finished for one in episodes), len(episodes)),
        gates_passed=mean([one.gates_passed for one in episodes]),
        mean_speed_mps=mean([one.mean_speed_mps for one in episodes]),
        stick_rate_per_s=mean(sticks),
        flown_s=mean([one.flown_s for one in episodes]),
        course_s=mean([one.course_s for one in episodes if one.course_s is not None]),
        outcomes=tuple(Counter(one.outcome for one in episodes).most_common()),
    )


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """One run of ``mavbridge evaluate``."""

    policy: str
    engine: str
    mode: str
    """"lockstep" or "realtime"."""
    conditions: Variety
    """random: those that ``python -m sitl --conditions`` draws from each episode's course seed."""
    vision_delay_ms: float
    """Added to the encoding of each image."""
    seed: int
    asked_episodes: int
    episodes: tuple[EpisodeResult, ...]
    """In the order of their seeds; fewer than asked for if the run was interrupted."""

    @property
    def setting(self) -> str:
        """How it was flown, in a few words."""
        parts = [self.mode]
        if self.conditions != "nominal":
            parts.append(f"{self.conditions} conditions")
        if self.vision_delay_ms:
            parts.append(f"images {self.vision_delay_ms:g} ms later")
        return ", ".join(parts)


def to_json(evaluation: Evaluation) -> str:
    """Everything as JSON, the summary first."""
    document = asdict(evaluation)
    episodes = document.pop("episodes")
    summary = asdict(summarise(evaluation.episodes)) if evaluation.episodes else None
    if summary is not None:
        summary["outcomes"] = dict(summary["outcomes"])
    return (
        json.dumps(
            {**document, "summary": summary, "episodes": episodes}, indent=2, allow_nan=False
        )
        + "\n"
    )
