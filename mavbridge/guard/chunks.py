"""Chunks of actions: whether one may be flown, for how long, and which action acts now."""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import ACTION_CLASSES, Action, ActionKind

LEAST_GRACE_NS = 100 * NS_PER_MS
GRACE_PERIODS = 3
"""A late chunk is bridged for 100 ms or three chunk periods, whichever is longer, but never for
more than 100 ms beyond the limits and the horizon of the one that is flown."""
MAX_REFUSED = 5
"""Malformed chunks within the window below that end the flight, even if good ones lie between."""
REFUSED_WINDOW_NS = NS_PER_S
REFUSED_WINDOW_PERIODS = 10
RECENT_GAPS = 8
PERIOD_TOLERANCE = 0.01
"""Share by which a horizon may be shorter than the chunk period: of one given as 0.033 s."""
LEAST_GAPS = 2
"""Chunks must have come in time for so long before a flight may begin."""
SLOW_CHUNKS = 5
"""So many solves in a row that outlast the limit of the attitude: this computer is too slow for the
policy. The first ones after loading may be slow."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FreshnessLimits:
    """Greatest ages of what a stick is computed from."""

    state_ns: int
    """Attitude and body rates."""
    velocity_ns: int
    """Velocity and acceleration."""
    feature_ns: int
    """Image, since its exposure."""
    chunk_ns: int
    """Since the chunk was computed."""
    stall_ns: int = LEAST_GRACE_NS
    """Longest time to fly on along a chunk when no newer one comes."""

    def while_played(self, play_ns: int) -> "FreshnessLimits":
        """Limits at the moment of sending, where a chunk is meant to be played for so long."""
        return FreshnessLimits(
            state_ns=self.state_ns + play_ns,
            velocity_ns=self.velocity_ns + play_ns,
            feature_ns=self.feature_ns + play_ns,
            chunk_ns=self.chunk_ns + play_ns,
            stall_ns=self.stall_ns,
        )


class Chunk(NamedTuple):
    """Actions of one solve of the policy, with the stamps of everything that it came from."""

    serial: int
    """Rises by one from chunk to chunk."""
    attitude_ns: int
    """When the attitude and the body rates happened, the older of the two."""
    velocity_ns: int
    """When velocity and acceleration happened, the older of the two."""
    image_ns: int
    """Exposure of the image."""
    computed_ns: int
    """When the solve was done."""
    first_ns: int
    """When the first action acts."""
    step_ns: int
    """Time from one action to the next."""
    actions: tuple[Action, ...]
    """All of one kind, in NED and FRD axes, in time order, as the policy put them out: not clipped,
    perhaps not finite."""
    reset_ns: int = 0
    """When the policy was last reset before the solve; 0: not since it was loaded."""

    @property
    def horizon_ns(self) -> int:
        """Time for which its actions act, one step each."""
        return len(self.actions) * self.step_ns

    @property
    def end_ns(self) -> int:
        """End of the horizon."""
        return self.first_ns + self.horizon_ns

    def action_at(self, at_ns: int) -> Action:
        """Action at a time, linear between the actions, held at both ends."""
        last = len(self.actions) - 1
        position = min(max((at_ns - self.first_ns) / self.step_ns, 0.0), float(last))
        low = int(position)
        weight = position - low
        first, second = self.actions[low], self.actions[min(low + 1, last)]
        pairs = zip(first, second, strict=True)
        return type(first)(*[(1.0 - weight) * a + weight * b for a, b in pairs])


_Input: TypeAlias = Literal["attitude", "velocity", "image", "chunk", "horizon"]
Place: TypeAlias = Literal["computer", "guard", "flight process", "solve", "link", "camera"]


class Lateness(NamedTuple):
    """The input that became too old to fly by, and where its time went."""

    name: _Input
    """chunk: none came for the grace. horizon: the last one ended before."""
    age_ns: int
    limit_ns: int
    place: Place
    stall_ns: int
    """Time that was spent there."""
    said: Reason | None = None
    """Why the flight process computed no chunk."""

    @property
    def reason(self) -> Reason:
        """The same as a reason to end a flight."""
        code, quantity = Code.LATE, str(self.name)
        if self.name == "horizon":
            code, quantity = Code.PAST_HORIZON, "chunk"
        reason = because(
            code,
            quantity=quantity,
            age_ms=self.age_ns / NS_PER_MS,
            limit_ms=self.limit_ns / NS_PER_MS,
            place=self.place,
            spent_ms=self.stall_ns / NS_PER_MS,
        )
        said: tuple[tuple[str, Reason], ...] = () if self.said is None else (("said", self.said),)
        return Reason(code, (*reason.data, *said))


class ChunkBuffer:
    """Holds the newest chunk that may be flown, and judges it at every send.

    A chunk is taken if it is well formed and within its limits when it arrives. From then on it is
    flown until the next one is taken: as fresh while it keeps its limits and the next one is not
    overdue, else coasting. ``fault`` says when even that must end.
    """

    def __init__(self, limits: FreshnessLimits, *, period_ns: int, kind: ActionKind) -> None:
        """Hold nothing yet.

        Args:
            limits: those at the moment of sending.
            period_ns: time between the policy's chunks.
            kind: that of their actions.
        """
        self._class = ACTION_CLASSES[kind]
        self._limits = limits
        self._period_ns = period_ns
        self.grace_ns = max(LEAST_GRACE_NS, GRACE_PERIODS * period_ns)
        self._refused_ns: deque[int] = deque(maxlen=MAX_REFUSED)
        self._malformation: Reason | None = None
        """What was wrong with the last malformed chunk."""
        self._refusal: Reason | None = None
        """Why the newest chunk was not taken; None if it was."""
        self._is_stale = False
        """It was refused for its age."""
        self.newest: Chunk | None = None
        self._seen: Chunk | None = None
        """The newest well-formed chunk, taken or not."""
        self._word_ns = 0
        """When the flight process last sent anything."""
        self._taken_ns = 0
        self._end_ns = 0
        """End of the horizon of the newest chunk."""
        self._uncovered_ns = 0
        """Time beyond the horizons of the last chunks in a row that ended before the next came."""
        self._grace_until_ns = 0
        """End of the grace of the newest chunk."""
        self._until_ns = 0
        """When the flight ends without a newer one: after the grace, or a stall."""
        self._gaps_ns: deque[int] = deque(maxlen=RECENT_GAPS)
        """Times between the last chunks that were taken."""
        self._slow = 0
        """Chunks in a row whose attitude was too old as soon as they were computed."""
        self._solve_ns = 0
        """From the newest chunk's attitude to the end of its solve."""

    def offer(self, chunk: Chunk, now_ns: int) -> bool:
        """Take a chunk if it may be flown; returns whether it was taken."""
        if self.newest is not None and chunk.serial <= self.newest.serial:
            return False
        self._word_ns, self._is_stale = now_ns, False
        if (malformation := self._malformed(chunk)) is not None:
            self._refused_ns.append(now_ns)
            self._malformation = malformation
            self.explain_absence(malformation, now_ns)
            return False
        self._solve_ns = chunk.computed_ns - chunk.attitude_ns
        self._slow = self._slow + 1 if self._solve_ns > self._limits.state_ns else 0
        end_ns, self._seen = self._horizon_end_ns(chunk, now_ns), chunk
        staleness = self._stale(chunk, now_ns)
        is_stale = staleness is not None
        if staleness is None and now_ns > end_ns:
            staleness = because(Code.AFTER_HORIZON, **_horizon(chunk))
        if staleness is not None:
            self.explain_absence(staleness, now_ns)
            self._is_stale = is_stale
            return False
        self._refusal = None
        if self.newest is not None:
            self._gaps_ns.append(now_ns - self._taken_ns)
            gap_ns = now_ns - self._end_ns
            uncovered_ns = self._uncovered_ns + gap_ns if gap_ns > 0 else 0
            self._uncovered_ns = min(uncovered_ns, LEAST_GRACE_NS)
        self.newest, self._taken_ns, self._end_ns = chunk, now_ns, end_ns
        limited_ns = max(now_ns, min(self._stale_ns(chunk), end_ns)) + LEAST_GRACE_NS
        self._grace_until_ns = min(now_ns + self.grace_ns, limited_ns - self._uncovered_ns)
        self._until_ns = self._grace_until_ns
        if max(self._gaps_ns, default=0) <= self.grace_ns:  # no stall so soon after another one
            planned_ns = min(now_ns + self._limits.stall_ns, end_ns)
            self._until_ns = max(self._grace_until_ns, planned_ns)
        return True

    def _horizon_end_ns(self, chunk: Chunk, taken_ns: int) -> int:
        """Moment until which a chunk that came at ``taken_ns`` has an action.

        A single action is no plan in time: it is held for its step from when it came, and for half
        a chunk period more, since solves wait for the next attitude.
        """
        if len(chunk.actions) == 1:
            return taken_ns + chunk.step_ns + self._period_ns // 2
        return chunk.end_ns

    def explain_absence(self, reason: Reason, now_ns: int) -> None:
        """Note why there is no chunk; whoever says so does not stall, and has the grace alone."""
        self._refusal, self._is_stale, self._word_ns = reason, False, now_ns
        graced_ns = max(self._grace_until_ns, now_ns - self._period_ns + self.grace_ns)
        self._until_ns = min(self._until_ns, graced_ns)

    @property
    def impossibility(self) -> Reason | None:
        """Why the policy can never fly on this computer at this rate, or None."""
        if self._is_short and (short := self._shortness()) is not None:
            return short
        if self._slow < SLOW_CHUNKS:
            return None
        return because(
            Code.TOO_SLOW,
            chunks=self._slow,
            age_ms=self._solve_ns / NS_PER_MS,
            limit_ms=self._limits.state_ns / NS_PER_MS,
        )

    def is_coasting(self, now_ns: int) -> bool:
        """The chunk is beyond its limits or its horizon, or the next is overdue by a period."""
        chunk = self.newest
        is_overdue = now_ns - self._taken_ns > 2 * self._period_ns or now_ns > self._end_ns
        return chunk is not None and (is_overdue or self._stale(chunk, now_ns) is not None)

    def problem(self, now_ns: int) -> Reason | None:
        """Why no flight may begin now, or None: a chunk must be fresh, by all limits."""
        chunk = self.newest
        if (flood := self._malformed_lately(now_ns)) is not None:
            return flood
        if (short := self._shortness()) is not None:
            return short
        if chunk is None or now_ns > self._grace_until_ns:
            return self._refusal or because(Code.NO_CHUNK)
        if len(self._gaps_ns) < LEAST_GAPS:
            return because(Code.JUST_BEGUN)
        bridged_ns = self._grace_until_ns - self._taken_ns
        if (gap_ns := max(self._gaps_ns)) > bridged_ns:
            advice = "it is too slow here for its rate; ask for a lower one"
            if bridged_ns < self.grace_ns:
                advice = (
                    "its limits and horizon let none be flown for longer; ask for a higher rate"
                )
            return because(
                Code.CHUNKS_APART,
                gap_ms=gap_ns / NS_PER_MS,
                bridged_ms=bridged_ns / NS_PER_MS,
                advice=advice,
            )
        return self._stale(chunk, now_ns)

    def fault(self, now_ns: int) -> Reason | None:
        """Why the flight must end now, or None: the grace is over, or too much was malformed."""
        if (flood := self._malformed_lately(now_ns)) is not None:
            return flood
        late = self.lateness(now_ns)
        return None if late is None else late.reason

    def is_over(self, now_ns: int) -> bool:
        """True if the grace has ended."""
        return self.newest is None or now_ns > self._until_ns

    def lateness(
        self, now_ns: int, *, stood_ns: int = 0, heard_ns: Mapping[str, int] | None = None
    ) -> Lateness | None:
        """The input that ended the grace, or None while it lasts.

        Args:
            now_ns: the moment.
            stood_ns: time for which the guard had not looked at anything until now.
            heard_ns: arrival of the vehicle's newest attitude and velocity, by these names.
        """
        if not self.is_over(now_ns):
            return None
        said = None if self._is_stale else self._refusal
        silent_ns = now_ns - self._word_ns
        if self._seen is None:
            return Lateness("chunk", silent_ns, self.grace_ns, "flight process", silent_ns, said)
        name, happened_ns, limit_ns = min(self._ages(self._seen), key=lambda age: age[1] + age[2])
        is_stall = self._until_ns > self._grace_until_ns  # which the ages may outgrow
        if is_stall or now_ns <= happened_ns + limit_ns:
            is_over = now_ns > self._end_ns
            name, happened_ns = "horizon" if is_over else "chunk", self._taken_ns
            limit_ns = (self._end_ns if is_over else self._until_ns) - self._taken_ns
        spent: dict[Place, int] = {
            "flight process": silent_ns,
            "solve": self._solve_ns,
            "link": now_ns - (heard_ns or {}).get(name, now_ns),
            "camera": self._word_ns - happened_ns if name == "image" else 0,
        }
        place = max(spent, key=lambda each: spent[each])
        if 2 * stood_ns >= spent[place]:
            place, spent["computer"] = "computer", stood_ns
        return Lateness(name, now_ns - happened_ns, limit_ns, place, spent[place], said)

    def _malformed_lately(self, now_ns: int) -> Reason | None:
        window_ns = max(REFUSED_WINDOW_NS, REFUSED_WINDOW_PERIODS * self._period_ns)
        refused = self._refused_ns
        is_flood = len(refused) >= MAX_REFUSED and now_ns - refused[0] < window_ns
        if not is_flood or self._malformation is None:
            return None
        return because(Code.UNUSABLE_CHUNKS, chunks=MAX_REFUSED, why=self._malformation)

    @property
    def _is_short(self) -> bool:
        """The newest chunk's horizon is shorter than the period of solves."""
        chunk, least_ns = self.newest, self._period_ns * (1 - PERIOD_TOLERANCE)
        return chunk is not None and chunk.horizon_ns < least_ns

    def _shortness(self) -> Reason | None:
        """Figures of a policy whose chunks end before the next one comes, or None."""
        chunk, gaps_ns = self.newest, sorted(self._gaps_ns)
        if chunk is None or not gaps_ns:
            return None
        gap_ns, covered_ns = gaps_ns[(len(gaps_ns) - 1) // 2], self._end_ns - self._taken_ns
        if gap_ns <= covered_ns and not self._is_short:
            return None
        return because(
            Code.HORIZON_TOO_SHORT,
            covered_ms=covered_ns / NS_PER_MS,
            gap_ms=max(gap_ns, self._period_ns) / NS_PER_MS,
            **_horizon(chunk),
        )

    def action_at(self, now_ns: int, lead_ns: int = 0) -> Action | None:
        """The action that acts ``lead_ns`` from now, or the last one where the horizon ends before.

        None beyond the horizon of the newest chunk.
        """
        if self.newest is None or now_ns > self._end_ns:
            return None
        return self.newest.action_at(now_ns + lead_ns)

    def _ages(self, chunk: Chunk) -> tuple[tuple[_Input, int, int], ...]:
        """What a chunk came from, when that happened, and how old it may be."""
        limits = self._limits
        return (
            ("attitude", chunk.attitude_ns, limits.state_ns),
            ("velocity", chunk.velocity_ns, limits.velocity_ns),
            ("image", chunk.image_ns, limits.feature_ns),
            ("chunk", chunk.computed_ns, limits.chunk_ns),
        )

    def _stale_ns(self, chunk: Chunk) -> int:
        """The last moment at which a chunk keeps its limits."""
        return min(happened_ns + limit_ns for _, happened_ns, limit_ns in self._ages(chunk))

    def _stale(self, chunk: Chunk, now_ns: int) -> Reason | None:
        for name, happened_ns, limit_ns in self._ages(chunk):
            if now_ns - happened_ns > limit_ns:
                age_ms, limit_ms = (now_ns - happened_ns) / NS_PER_MS, limit_ns / NS_PER_MS
                return because(Code.TOO_OLD, quantity=name, age_ms=age_ms, limit_ms=limit_ms)
        return None

    def _malformed(self, chunk: Chunk) -> Reason | None:
        if not chunk.actions or chunk.step_ns <= 0:
            return because(Code.EMPTY_CHUNK)
        if not all(type(action) is self._class for action in chunk.actions):
            return because(Code.WRONG_KIND)
        if not all(math.isfinite(sum(action)) for action in chunk.actions):
            return because(Code.NOT_FINITE)
        return None


def _horizon(chunk: Chunk) -> dict[str, float]:
    return {
        "horizon_ms": chunk.horizon_ns / NS_PER_MS,
        "steps": len(chunk.actions),
        "step_ms": chunk.step_ns / NS_PER_MS,
    }
