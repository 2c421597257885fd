"""Action chunks: their checks, their lifetime and the action for each moment."""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeAlias

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because, too_old
from mavbridge.core.vehicle import ACTION_CLASSES, Action, ActionKind, Telemetry

LEAST_GRACE_NS = 100 * NS_PER_MS
GRACE_PERIODS = 3
"""The grace, the time for which a late chunk is bridged: 100 ms or three chunk periods, whichever
is longer, but at most 100 ms beyond the age limits and the horizon of the current chunk."""
MAX_REFUSED = 5
"""Malformed chunks in the refusal window that end the flight, even with good ones in between."""
_MALFORMED = (Code.EMPTY_CHUNK, Code.WRONG_KIND, Code.NOT_FINITE, Code.WRONG_SHAPE)
"""What makes a chunk malformed; the flight process finds a wrong shape itself."""
REFUSED_WINDOW_NS = NS_PER_S
REFUSED_WINDOW_PERIODS = 10
RECENT_GAPS = 8
LEAST_GAPS = 2
"""Gaps between chunks that must have been seen before a flight may begin."""
SLOW_CHUNKS = 5
"""Consecutive solves that take longer than the attitude's age limit and show that this computer is
too slow for the policy. More than one, since the first solves after loading may be slow."""
_UNSEEN = Telemetry()


@dataclass(frozen=True, slots=True, kw_only=True)
class FreshnessLimits:
    """Maximum age of each input to a stick command [ns]."""

    state_ns: int
    """Attitude and body rates."""
    velocity_ns: int
    """Velocity and acceleration."""
    feature_ns: int
    """Image, from its exposure."""
    chunk_ns: int
    """Chunk, from the end of its solve."""
    stall_ns: int = LEAST_GRACE_NS
    """Longest time to keep flying a chunk while no newer one arrives."""

    def while_played(self, play_ns: int) -> "FreshnessLimits":
        """Return the limits at the time of sending, for chunks played for ``play_ns``."""
        played = ("state_ns", "velocity_ns", "feature_ns", "chunk_ns")
        return replace(self, **{name: getattr(self, name) + play_ns for name in played})


class Chunk(NamedTuple):
    """Actions of one solve of the policy, with the timestamps of its inputs."""

    serial: int
    """Increases by one with each chunk."""
    attitude_ns: int
    """Measurement time of the attitude or the body rates, whichever is older."""
    velocity_ns: int
    """Measurement time of velocity or acceleration, whichever is older."""
    image_ns: int
    """Exposure time of the image."""
    computed_ns: int
    """End of the solve."""
    first_ns: int
    """Time of the first action."""
    step_ns: int
    """Time from one action to the next."""
    actions: tuple[Action, ...]
    """Raw actions in time order, of one kind, NED and FRD axes; unclipped, perhaps not finite."""
    reset_ns: int = 0
    """Last reset of the policy before the solve; 0: none since loading."""

    @property
    def horizon_ns(self) -> int:
        """Duration of the actions, one step each."""
        return len(self.actions) * self.step_ns

    @property
    def end_ns(self) -> int:
        """End of the horizon."""
        return self.first_ns + self.horizon_ns

    def action_at(self, at_ns: int) -> Action:
        """Return the action at a time: linear between actions, constant beyond both ends."""
        last = len(self.actions) - 1
        position = min(max((at_ns - self.first_ns) / self.step_ns, 0.0), float(last))
        low = int(position)
        weight = position - low
        first, second = self.actions[low], self.actions[min(low + 1, last)]
        pairs = zip(first, second, strict=True)
        return type(first)(*[(1.0 - weight) * a + weight * b for a, b in pairs])


_Input: TypeAlias = Literal["attitude", "velocity", "image", "chunk"]
Place: TypeAlias = Literal["computer", "guard", "flight process", "solve", "lag", "link", "camera"]


def late(
    name: _Input | Literal["horizon"],
    age_ns: int,
    limit_ns: int,
    place: Place,
    spent_ns: int,
    said: Reason | None = None,
) -> Reason:
    """Return the reason to end a flight because an input is too old.

    ``name``: chunk: none arrived within the grace; horizon: the last chunk ended first.
    ``place``: where ``spent_ns`` were lost. ``said``: why the flight process computed no chunk.
    """
    code, quantity = (Code.PAST_HORIZON, "chunk") if name == "horizon" else (Code.LATE, name)
    return because(
        code,
        quantity=quantity,
        age_ms=age_ns / NS_PER_MS,
        limit_ms=limit_ns / NS_PER_MS,
        place=place,
        spent_ms=spent_ns / NS_PER_MS,
        **({} if said is None else {"said": said}),
    )


class ChunkBuffer:
    """Newest chunk that may be flown, checked again at every send.

    A chunk is taken if it is well formed and within its limits on arrival. It is then flown until
    the next one is taken: fresh while it is within its limits and the next one is not overdue,
    coasting after that. ``fault`` tells when coasting must end.
    """

    def __init__(self, limits: FreshnessLimits, *, period_ns: int, kind: ActionKind) -> None:
        """Create an empty buffer.

        Args:
            limits: maximum ages at the moment of sending.
            period_ns: time between the policy's chunks.
            kind: kind of their actions.
        """
        self._class = ACTION_CLASSES[kind]
        self._limits = limits
        self._period_ns = period_ns
        self.grace_ns = max(LEAST_GRACE_NS, GRACE_PERIODS * period_ns)
        self._malformed: deque[tuple[int, Reason]] = deque(maxlen=MAX_REFUSED)
        """Times and defects of the last malformed chunks."""
        self._refusal: Reason | None = None
        """Why the newest chunk was not taken; None if it was."""
        self._is_stale = False
        """True if the newest chunk was refused for its age."""
        self.newest: Chunk | None = None
        self._seen: Chunk | None = None
        """The newest well-formed chunk, taken or not."""
        self._word_ns = 0
        """Time of the flight process's last message about chunks."""
        self._taken_ns = 0
        self._end_ns = 0
        """End of the horizon of the newest chunk."""
        self._uncovered_ns = 0
        """Total gap after the horizons of the last chunks in a row that ended too early."""
        self._grace_until_ns = 0
        """End of the grace of the newest chunk."""
        self._until_ns = 0
        """End of the grace or of the allowed stall, whichever is later: ends the flight."""
        self._gaps_ns: deque[int] = deque(maxlen=RECENT_GAPS)
        """Times between the last accepted chunks."""
        self._slow = 0
        """Consecutive chunks whose attitude was too old by the end of the solve."""
        self._solve_ns = 0
        """Time from the newest chunk's attitude to the end of its solve."""

    def offer(self, chunk: Chunk, now_ns: int) -> bool:
        """Take a chunk if it may be flown. Return True if it was taken."""
        if self.newest is not None and chunk.serial <= self.newest.serial:
            return False
        self._refusal, self._is_stale, self._word_ns = None, False, now_ns
        if (defect := self._defect(chunk)) is not None:
            self.explain_absence(defect, now_ns)
            return False
        self._solve_ns = chunk.computed_ns - chunk.attitude_ns
        self._slow = self._slow + 1 if self._solve_ns > self._limits.state_ns else 0
        end_ns, self._seen = self._horizon_end_ns(chunk, now_ns), chunk
        staleness = self._stale(chunk, now_ns)
        if staleness is not None or now_ns > end_ns:
            why = staleness or because(Code.AFTER_HORIZON, **_horizon(chunk))
            self.explain_absence(why, now_ns)
            self._is_stale = staleness is not None
            return False
        if self.newest is not None:
            self._gaps_ns.append(now_ns - self._taken_ns)
            gap_ns = now_ns - self._end_ns
            uncovered_ns = self._uncovered_ns + gap_ns if gap_ns > 0 else 0
            self._uncovered_ns = min(uncovered_ns, LEAST_GRACE_NS)
        self.newest, self._taken_ns, self._end_ns = chunk, now_ns, end_ns
        limits_ns = (happened_ns + limit_ns for _, happened_ns, limit_ns in self._ages(chunk))
        limited_ns = max(now_ns, min(end_ns, *limits_ns)) + LEAST_GRACE_NS
        self._grace_until_ns = min(now_ns + self.grace_ns, limited_ns - self._uncovered_ns)
        self._until_ns = self._grace_until_ns
        if max(self._gaps_ns, default=0) <= self.grace_ns:  # no second stall soon after one
            planned_ns = min(now_ns + self._limits.stall_ns, end_ns)
            self._until_ns = max(self._grace_until_ns, planned_ns)
        return True

    def _horizon_end_ns(self, chunk: Chunk, taken_ns: int) -> int:
        """Return the end of the actions of a chunk that arrived at ``taken_ns``.

        A single action has no time course. It is held from its arrival for its step plus half a
        chunk period, since solves wait for the next attitude.
        """
        if len(chunk.actions) == 1:
            return taken_ns + chunk.step_ns + self._period_ns // 2
        return chunk.end_ns

    def explain_absence(self, reason: Reason, now_ns: int) -> None:
        """Note why there is no chunk; the flight process answers, so no stall is bridged."""
        self._refusal, self._is_stale, self._word_ns = reason, False, now_ns
        if reason.code in _MALFORMED:
            self._malformed.append((now_ns, reason))
        graced_ns = max(self._grace_until_ns, now_ns - self._period_ns + self.grace_ns)
        self._until_ns = min(self._until_ns, graced_ns)

    @property
    def impossibility(self) -> Reason | None:
        """Why the policy can never fly on this computer at this rate; None: it can."""
        if self._slow < SLOW_CHUNKS:
            return None
        return because(
            Code.TOO_SLOW,
            chunks=self._slow,
            age_ms=self._solve_ns / NS_PER_MS,
            limit_ms=self._limits.state_ns / NS_PER_MS,
        )

    def is_coasting(self, now_ns: int) -> bool:
        """True if the chunk exceeds its limits or horizon, or the next is overdue by a period."""
        chunk = self.newest
        is_overdue = now_ns - self._taken_ns > 2 * self._period_ns or now_ns > self._end_ns
        return chunk is not None and (is_overdue or self._stale(chunk, now_ns) is not None)

    def problem(self, now_ns: int) -> Reason | None:
        """Return why no flight may begin now, or None if the chunk is fresh by all limits."""
        chunk = self.newest
        if (defect := self._malformed_lately(now_ns) or self._shortness()) is not None:
            return defect
        if chunk is None or now_ns > self._grace_until_ns:
            return self._refusal or because(Code.NO_CHUNK)
        if len(self._gaps_ns) < LEAST_GAPS:
            return because(Code.JUST_BEGUN)
        bridged_ns = self._grace_until_ns - self._taken_ns
        if long_ns := [gap_ns for gap_ns in self._gaps_ns if gap_ns > bridged_ns]:
            often = Code.CHUNKS_BEYOND_PLAN if bridged_ns < self.grace_ns else Code.CHUNKS_APART
            return because(
                often if len(long_ns) > 1 else Code.CHUNKS_RESUMED,
                gap_ms=max(long_ns) / NS_PER_MS,
                bridged_ms=bridged_ns / NS_PER_MS,
            )
        return self._stale(chunk, now_ns)

    def fault(self, now_ns: int) -> Reason | None:
        """Return why the flight must end now, or None: grace over, or malformed chunks."""
        return self._malformed_lately(now_ns) or self.lateness(now_ns)

    def lateness(
        self,
        now_ns: int,
        *,
        stood_ns: int = 0,
        seen: Telemetry = _UNSEEN,
        arriving: Chunk | None = None,
    ) -> Reason | None:
        """Return the reason with the input whose age ended the grace, or None during the grace.

        Args:
            now_ns: current time.
            stood_ns: duration of the guard's stall until now.
            seen: newest readings of the vehicle.
            arriving: chunk that has just arrived.
        """
        if self.newest is not None and now_ns <= self._until_ns:
            return None
        said, silent_ns = None if self._is_stale else self._refusal, now_ns - self._word_ns
        if self._seen is None:
            return late("chunk", silent_ns, self.grace_ns, "flight process", silent_ns, said)
        name: _Input | Literal["horizon"]
        name, happened_ns, limit_ns = min(self._ages(self._seen), key=lambda age: age[1] + age[2])
        is_stall = self._until_ns > self._grace_until_ns  # ages may exceed their limits then
        if is_stall or now_ns <= happened_ns + limit_ns:
            is_over = now_ns > self._end_ns
            name, happened_ns = "horizon" if is_over else "chunk", self._taken_ns
            limit_ns = (self._end_ns if is_over else self._until_ns) - self._taken_ns
        turned, moved = seen.motion[:2], seen.motion[2:]
        lag_ns = max([0, *(each.delay_ns for each in turned if each)])
        source = {"attitude": turned, "velocity": moved}.get(name, ())
        spent: dict[Place, int] = {
            "flight process": silent_ns,
            "solve": self._solve_ns - lag_ns,
            "lag": lag_ns,
            "link": max([0, *(now_ns - each.arrived_ns for each in source if each)]),
            "camera": self._word_ns - happened_ns if name == "image" else 0,
        }
        place = max(spent, key=lambda each: spent[each])
        if 2 * stood_ns >= spent[place]:
            # A chunk computed in the second half of the stall shows that only the guard stalled.
            was_solving = arriving is not None and arriving.computed_ns > now_ns - stood_ns // 2
            place = "guard" if was_solving else "computer"
            spent[place] = stood_ns
        if said is not None and 4 * spent[place] < now_ns - happened_ns:
            place = "flight process"  # which answers: nothing stood still
        return late(name, now_ns - happened_ns, limit_ns, place, spent[place], said)

    def _malformed_lately(self, now_ns: int) -> Reason | None:
        window_ns = max(REFUSED_WINDOW_NS, REFUSED_WINDOW_PERIODS * self._period_ns)
        if len(self._malformed) < MAX_REFUSED or now_ns - self._malformed[0][0] >= window_ns:
            return None
        return because(Code.UNUSABLE_CHUNKS, chunks=MAX_REFUSED, why=self._malformed[-1][1])

    def _shortness(self) -> Reason | None:
        """Return the figures of a policy whose chunks end before the next one arrives, or None."""
        chunk, gaps_ns = self.newest, sorted(self._gaps_ns)
        if chunk is None or not gaps_ns:
            return None
        gap_ns, covered_ns = gaps_ns[(len(gaps_ns) - 1) // 2], self._end_ns - self._taken_ns
        if gap_ns <= covered_ns:
            return None
        return because(
            Code.HORIZON_TOO_SHORT,
            covered_ms=covered_ns / NS_PER_MS,
            gap_ms=gap_ns / NS_PER_MS,
            **_horizon(chunk),
        )

    def action_at(self, now_ns: int, lead_ns: int = 0) -> Action | None:
        """Return the action at ``now_ns + lead_ns``, or the last one if the horizon ends first.

        Return None if ``now_ns`` is beyond the horizon of the newest chunk.
        """
        if self.newest is None or now_ns > self._end_ns:
            return None
        return self.newest.action_at(now_ns + lead_ns)

    def _ages(self, chunk: Chunk) -> tuple[tuple[_Input, int, int], ...]:
        """Return name, timestamp and age limit of each input of a chunk."""
        limits = self._limits
        return (
            ("attitude", chunk.attitude_ns, limits.state_ns),
            ("velocity", chunk.velocity_ns, limits.velocity_ns),
            ("image", chunk.image_ns, limits.feature_ns),
            ("chunk", chunk.computed_ns, limits.chunk_ns),
        )

    def _stale(self, chunk: Chunk, now_ns: int) -> Reason | None:
        for name, happened_ns, limit_ns in self._ages(chunk):
            if (age_ns := now_ns - happened_ns) > limit_ns:
                return too_old(name, age_ns, limit_ns)
        return None

    def _defect(self, chunk: Chunk) -> Reason | None:
        if not chunk.actions or chunk.step_ns <= 0:
            return because(Code.EMPTY_CHUNK)
        if set(map(type, chunk.actions)) != {self._class}:
            return because(Code.WRONG_KIND)
        if not all(map(math.isfinite, map(sum, chunk.actions))):
            return because(Code.NOT_FINITE)
        return None


def _horizon(chunk: Chunk) -> dict[str, float]:
    return {
        "horizon_ms": chunk.horizon_ns / NS_PER_MS,
        "steps": len(chunk.actions),
        "step_ms": chunk.step_ns / NS_PER_MS,
    }
