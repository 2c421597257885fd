"""Who held the sticks of a recorded flight, and when."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from mavbridge.core.clock import NS_PER_S
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
    reason: str
    """Why the policy did not fly; empty while it did."""


def holder_of(tick: Tick) -> Holder:
    """Who held the sticks after this tick."""
    if tick.trace is not None:
        return "read-only" if tick.sent is None else "policy"
    if tick.sent is not None:
        return "idle" if tick.phase == "preparing" else "neutral"
    return "release" if tick.phase == "releasing" else "pilot"


def holder_spans(ticks: Sequence[Tick], start_ns: int) -> tuple[HolderSpan, ...]:
    """Stretches in the order of time; a new reason while nothing is sent does not begin one."""
    spans: list[HolderSpan] = []
    for number, tick in enumerate(ticks):
        at_s = (tick.woke_ns - start_ns) / NS_PER_S
        end_s = at_s
        if number + 1 < len(ticks):
            end_s = (ticks[number + 1].woke_ns - start_ns) / NS_PER_S
        holder = holder_of(tick)
        if spans and spans[-1].holder == holder:
            last = spans[-1]
            spans[-1] = HolderSpan(
                start_s=last.start_s, end_s=end_s, holder=holder, reason=last.reason
            )
        else:
            reason = "" if tick.trace is not None else tick.release_reason or ""
            spans.append(HolderSpan(start_s=at_s, end_s=end_s, holder=holder, reason=reason))
    return tuple(spans)
