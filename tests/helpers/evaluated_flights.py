"""Episodes with plain figures."""

from dataclasses import replace
from typing import Any

from mavbridge.simulation.referee import EpisodeResult

FINISHED = EpisodeResult(
    course_seed=1_000_000,
    seed=0,
    outcome="finished",
    gates_total=2,
    gate_times_s=(4.0, 9.0),
    flown_s=10.0,
    distance_m=30.0,
    stick_rate_per_s=0.5,
)


def finished(**changes: Any) -> EpisodeResult:
    return replace(FINISHED, **changes)


def crashed(**changes: Any) -> EpisodeResult:
    base = replace(
        FINISHED, outcome="crashed", gate_times_s=(4.0,), flown_s=5.0, stick_rate_per_s=None
    )
    return replace(base, **changes)
