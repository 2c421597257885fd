"""Who held the sticks of a recorded flight, and when."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Reason
from mavbridge.core.records import Tick

Holder = Literal["policy", "read-only", "idle", "neutral", "release", "pilot"]
"""idle: ours, before the policy flies; neutral: ours, on the way out; release: given back, not yet
confirmed; pilot: whoever has them while we send nothing, a receiver, or the autopilot alone."""


@dataclass(frozen=True, kw_only=True)
class HolderSpan:
    """A stretch of time with one holder."""

    start_s: float
    """Since the first tick."""
    end_s: float
    holder: Holder
    reason: Reason | None
    """Why the policy did not fly, for most of the time; None while it did."""


def holder_of(tick: Tick) -> Holder:
    """Who held the sticks after this tick."""
    if tick.trace is not None:
        return "read-only" if tick.sent is None else "policy"
    if tick.sent is not None:
        return "idle" if tick.phase == "preparing" else "neutral"
    return "release" if tick.phase == "releasing" else "pilot"


def holder_spans(ticks: Sequence[Tick], start_ns: int) -> tuple[HolderSpan, ...]:
    """Stretches in the order of time; a new reason does not begin one, the longest one is told."""
    spans: list[HolderSpan] = []
    at = 0
    for holder, group in groupby(ticks, holder_of):
        first = at
        lasted_ns: dict[object, int] = {}
        reasons: dict[object, Reason | None] = {}
        for tick in group:
            at += 1
            end_ns = ticks[min(at, len(ticks) - 1)].woke_ns
            reason = None if tick.trace is not None else tick.release_reason
            key = None if reason is None else reason.key
            lasted_ns[key] = lasted_ns.get(key, 0) + end_ns - tick.woke_ns
            reasons[key] = reason
        spans.append(
            HolderSpan(
                start_s=(ticks[first].woke_ns - start_ns) / NS_PER_S,
                end_s=(end_ns - start_ns) / NS_PER_S,
                holder=holder,
                reason=reasons[max(lasted_ns, key=lasted_ns.__getitem__)],
            )
        )
    return tuple(spans)
