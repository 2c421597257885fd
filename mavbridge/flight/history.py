"""Actions between the axes of the policy's contract and those of the guard, and their history.

The guard, its limits and MAVLink use NED world and FRD body axes. A policy with ``state_frame =
"enu_flu"`` (ROS, REP 103) outputs actions, and reads its action history, in ENU and FLU. The
conversion is its own inverse.
"""

import threading
from bisect import bisect_right
from collections.abc import Sequence
from copy import copy

import numpy as np

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.records import FloatArray
from mavbridge.core.vehicle import ACTION_CLASSES, Action
from mavbridge.guard.chunks import Chunk
from mavbridge.guard.limits import ActionSmoother
from mavbridge.guard.values import FlightSettings
from policy.contract import Contract, history_ages_ns

REPORTED_NS = 10 * NS_PER_MS
"""Age of a sent action from which the guard has reported it, in flight as in a replay."""


class ActionFrame:
    """Kind and axes of a policy's actions; converts them to NED and FRD, and back."""

    def __init__(self, contract: Contract) -> None:
        thrust = contract.hover_thrust if contract.action in ("rates", "attitude") else 0.0
        self.neutral: Action = ACTION_CLASSES[contract.action](thrust, 0.0, 0.0, 0.0)
        """Zeros, or zeros with hover thrust. Equal in both frames."""
        self._axes = _other_axes(contract)

    def to_guard(self, actions: FloatArray) -> tuple[Action, ...]:
        """Convert policy actions [horizon, 4] to NED and FRD actions."""
        kind = type(self.neutral)
        return tuple(map(kind._make, self._converted(actions).tolist()))

    def from_guard(self, actions: Sequence[Action]) -> FloatArray:
        """Convert sent actions of the policy's kind to its frame, [len, 4]."""
        return self._converted(np.array(actions, dtype=np.float32))

    def _converted(self, actions: FloatArray) -> FloatArray:
        if self._axes is None:
            return actions
        order, signs = self._axes
        return actions[:, order] * np.array(signs, dtype=np.float32)


def _other_axes(contract: Contract) -> tuple[tuple[int, ...], tuple[float, ...]] | None:
    """Return order and signs of the conversion: component ``i`` in one frame is ``signs[i]`` times
    component ``order[i]`` in the other. None: the frames are the same."""
    kind = contract.action
    if contract.state_frame == "ned_frd" or kind == "sticks":
        return None
    if kind == "velocity" and contract.velocity_frame == "world":
        # East, north, up, left turn <-> north, east, down, right turn.
        return (1, 0, 2, 3), (1.0, 1.0, -1.0, -1.0)
    if kind == "velocity":  # forward, left, up <-> forward, right, down
        return (0, 1, 2, 3), (1.0, -1.0, -1.0, -1.0)
    return (0, 1, 2, 3), (1.0, 1.0, -1.0, -1.0)


class SentHistory:
    """Sent actions, resampled on the policy's history grid in the policy's frame.

    One thread may append while another one resamples.
    """

    def __init__(self, contract: Contract) -> None:
        """Create a neutral history of the policy's kind of actions."""
        self._frame = ActionFrame(contract)
        self._ages_ns = history_ages_ns(contract.history_len, contract.history_dt_s)
        self._span_ns = self._ages_ns[0] + self._ages_ns[-1]
        self._lock = threading.Lock()
        self._sent_ns: list[int] = []
        self._sent: list[Action] = [self._frame.neutral]
        """One action more than stamps: the first is the one before the first stamp."""

    def append(self, sent: Action | None, now_ns: int) -> None:
        """Add the action sent at ``now_ns``; None: control was released. Old actions are
        dropped."""
        with self._lock:
            self._sent_ns.append(now_ns)
            self._sent.append(self._frame.neutral if sent is None else sent)
            if (old := bisect_right(self._sent_ns, now_ns - self._span_ns)) > 1:
                del self._sent_ns[: old - 1], self._sent[: old - 1]

    def at(self, at_ns: int) -> Action:
        """Return the action flown at a time, of the policy's kind, in NED and FRD axes.

        An action of another kind is neutral: while it prepares the vehicle, or levels one that is
        flown by body rates, the guard sends actions that the policy does not know.
        """
        with self._lock:
            action = self._sent[bisect_right(self._sent_ns, at_ns)]
        return action if type(action) is type(self._frame.neutral) else self._frame.neutral

    def foreseen(
        self, plan: Chunk, guard: FlightSettings, now_ns: int, until_ns: int
    ) -> "SentHistory":
        """Return a copy that goes on until ``until_ns`` as the guard will send ``plan``."""
        ahead = copy(self)
        with self._lock:
            known = bisect_right(self._sent_ns, now_ns - REPORTED_NS)
            ahead._sent_ns, ahead._sent = self._sent_ns[:known], self._sent[: known + 1]
        first_ns = max([plan.computed_ns, *ahead._sent_ns[-1:]])
        smoother = ActionSmoother(guard.smoothing, ahead.at(first_ns))
        lead_ns = round(guard.smoothing.tau_s * NS_PER_S)
        for at_ns in range(first_ns, until_ns, guard.stick_period_ns):
            ahead._sent_ns.append(at_ns)
            ahead._sent.append(smoother.step(plan.action_at(at_ns + lead_ns), at_ns).smoothed)
        return ahead

    def committed(self, plan: Chunk | None, times_ns: Sequence[int], until_ns: int) -> FloatArray:
        """Return the actions [1, len(times_ns), 4] that fly at these times, those of the ``plan``
        unfiltered; NaN from ``until_ns`` on, and without a plan."""
        prefix = np.full((1, len(times_ns), 4), np.nan, np.float32)
        soon_ns = [] if plan is None else [at_ns for at_ns in times_ns if at_ns < until_ns]
        if plan is not None and soon_ns:
            flown = [
                plan.action_at(at_ns) if at_ns >= plan.computed_ns else self.at(at_ns)
                for at_ns in soon_ns
            ]
            prefix[0, : len(flown)] = self._frame.from_guard(flown)
        return prefix

    def resample(self, at_ns: int) -> FloatArray:
        """Return the history [1, K, 4] on the grid of ``policy.contract.history_ages_ns``."""
        rows = [self.at(at_ns - age_ns) for age_ns in self._ages_ns]
        return self._frame.from_guard(rows)[None]
