"""Results of an evaluation: estimates with 95 % intervals, summary, table and JSON."""

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np
from rich.console import Console
from rich.text import Text

from mavbridge.commands.output import make_table
from mavbridge.config.episodes import EvaluateConfig
from mavbridge.simulation.referee import EpisodeResult, Outcome

Z95 = 1.959963984540054
"""95 % of a normal distribution are within this many standard deviations."""
_BLOCKS, _BLOCK = 100, 100
"""10,000 resamples, one block at a time."""
_SEED = 0
"""Seed of the resampling, so that equal flights have equal intervals."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Mean or rate; the interval is None if a single flight gives none."""

    value: float
    low: float | None
    high: float | None
    count: int


def rate(successes: int, count: int) -> Estimate:
    """Return the success rate with Wilson's score interval (E. B. Wilson 1927, JASA 22, 209-212).

    Raises:
        ValueError: no trials, or more successes than trials.
    """
    if not 0 <= successes <= count or count == 0:
        raise ValueError(f"{successes} successes of {count} are no rate")
    share, z2 = successes / count, Z95**2
    centre = (share + z2 / (2 * count)) / (1 + z2 / count)
    spread = math.sqrt(share * (1 - share) / count + z2 / (4 * count**2))
    half = Z95 * spread / (1 + z2 / count)
    return Estimate(
        value=share, low=max(0.0, centre - half), high=min(1.0, centre + half), count=count
    )


def mean(values: Sequence[float]) -> Estimate | None:
    """Return the mean with a percentile bootstrap interval (B. Efron 1979); None without values."""
    if not values:
        return None
    sample = np.asarray(values, dtype=np.float64)
    low = high = None
    if len(sample) > 1:
        random = np.random.Generator(np.random.PCG64(_SEED))
        size = (_BLOCK, len(sample))
        means = [
            sample[random.integers(len(sample), size=size)].mean(axis=1) for _ in range(_BLOCKS)
        ]
        low, high = (float(bound) for bound in np.percentile(means, (2.5, 97.5)))
    return Estimate(value=float(sample.mean()), low=low, high=high, count=len(sample))


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Figures over all episodes unless stated otherwise; None: no episode has the figure."""

    success_rate: Estimate
    """Success: all gates in order, no crash."""
    gates_passed: Estimate | None
    mean_speed_mps: Estimate | None
    """Path length over time, take-off included."""
    course_speed_mps: Estimate | None
    """Length of the straight legs over time, from the first gate to the last one passed."""
    stick_rate_per_s: Estimate | None
    """Mean |change| of a number of the action per second; lower is smoother."""
    flown_s: Estimate | None
    course_s: Estimate | None
    """Time from the first action to the last gate, of the successful flights."""
    outcomes: tuple[tuple[Outcome, int], ...]


def summarise(episodes: Sequence[EpisodeResult]) -> Summary:
    """Compute the figures of one or more episodes.

    Raises:
        ValueError: there are none.
    """
    speeds = [one.course_speed_mps for one in episodes]
    sticks = [one.stick_rate_per_s for one in episodes if one.stick_rate_per_s is not None]
    return Summary(
        success_rate=rate(sum(one.has_finished for one in episodes), len(episodes)),
        gates_passed=mean([one.gates_passed for one in episodes]),
        mean_speed_mps=mean([one.mean_speed_mps for one in episodes]),
        course_speed_mps=mean([speed for speed in speeds if speed is not None]),
        stick_rate_per_s=mean(sticks),
        flown_s=mean([one.flown_s for one in episodes]),
        course_s=mean([one.course_s for one in episodes if one.course_s is not None]),
        outcomes=tuple(Counter(one.outcome for one in episodes).most_common()),
    )


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Results of one run of ``mavbridge evaluate``."""

    config: EvaluateConfig
    engine: str
    """Empty if no episode was flown."""
    episodes: tuple[EpisodeResult, ...]
    """In the order of their seeds; fewer than configured if the run was interrupted."""

    @cached_property
    def summary(self) -> Summary:
        """Figures of the episodes, of which at least one must exist."""
        return summarise(self.episodes)

    @property
    def title(self) -> str:
        """Policy, engine, and the conditions that differ from the default."""
        config = self.config
        parts = [f"{config.policy.policy} ({self.engine})"]
        if config.conditions != "nominal":
            parts.append(f"{config.conditions} conditions")
        if config.gusts is not None:
            parts.append(f"gusts of {config.gusts:g} m/s")
        if config.vision_delay:
            parts.append(f"images {config.vision_delay:g} ms later")
        return ", ".join(parts)


def to_json(evaluation: Evaluation, flown_by: str) -> str:
    """Return all results as JSON, the summary before the episodes; without episodes it is null.

    ``flown_by`` identifies the setup of the flights (``evaluate.run.identity``).
    """
    config, summary = evaluation.config, None
    if evaluation.episodes:
        summary = asdict(evaluation.summary)
        summary["outcomes"] = dict(summary["outcomes"])
    document = {
        "policy": config.policy.policy,
        "engine": evaluation.engine,
        "conditions": config.conditions,
        "gusts_mps": config.gusts,
        "vision_delay_ms": config.vision_delay,
        "seed": config.policy.seed,
        "asked_episodes": config.episodes,
        "flown_by": flown_by,
        "summary": summary,
        "episodes": [asdict(one) for one in evaluation.episodes],
    }
    return json.dumps(document, indent=2, allow_nan=False) + "\n"


def print_evaluation(evaluation: Evaluation, console: Console) -> None:
    """Print each figure with its 95 % interval, then how the flights ended."""
    summary = evaluation.summary
    figures = (
        (f"gates passed, of {evaluation.episodes[0].gates_total}", summary.gates_passed),
        ("mean speed, m/s", summary.mean_speed_mps),
        ("speed from gate to gate, m/s", summary.course_speed_mps),
        ("change of actions, 1/s", summary.stick_rate_per_s),
        ("flown, s", summary.flown_s),
        ("course time, s (successful flights)", summary.course_s),
    )
    rows = [("success rate", *_cells(summary.success_rate, "{:.1%}"))]
    rows += [(name, *_cells(estimate, "{:.2f}")) for name, estimate in figures]
    header = ("", "mean", "95 % interval", "flights")
    console.print(make_table(evaluation.title, header, rows))
    ends = ", ".join(f"{count} {outcome}" for outcome, count in summary.outcomes)
    console.print(Text(f"{len(evaluation.episodes)} flights: {ends}"))


def _cells(estimate: Estimate | None, form: str) -> tuple[str, str, str]:
    if estimate is None:
        return "-", "-", "0"
    interval = "-"
    if estimate.low is not None and estimate.high is not None:
        interval = f"{form.format(estimate.low)} to {form.format(estimate.high)}"
    return form.format(estimate.value), interval, str(estimate.count)
