"""End and result of an episode, one flight of one course."""

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import MavbridgeError, PeerError
from mavbridge.core.reasons import Reason
from mavbridge.core.records import Event, Tick
from mavbridge.core.vehicle import Action
from mavbridge.flight.outcome import RUN_OUT_NS, Standstill
from policy.contract import ACTION_DIM
from sitl.course import GatePass, make_course
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.rotation import Vec3

READY_NS = 30 * NS_PER_S
"""Limit from the start to the policy's first action, which comes after some 4 s."""
RUN_OUT_S = RUN_OUT_NS / NS_PER_S
"""Time from the last gate to the end, as in a flight in real time."""
STOPPED_MPS = 0.3
"""Speed below which the vehicle has stopped."""
Outcome = Literal["finished", "crashed", "disarmed", "stopped", "timed out"]
"""All gates passed; ground or gate hit; motors stopped in flight; the policy stopped before the
last gate; none of these in time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeResult:
    """Result of one flight of one course. Times count from the policy's first action."""

    course_seed: int
    seed: int
    outcome: Outcome
    gates_total: int
    gate_times_s: tuple[float, ...]
    flown_s: float
    """Time to the end of the episode: the run-out after the last gate, the crash, or the limit."""
    distance_m: float
    stick_rate_per_s: float | None
    """Mean over the four sticks of |change| per second, as sent; full deflection is 1. None = the
    policy never had the sticks for two actions in a row."""
    lost: Reason | None = None
    """Why the policy lost control before the end; None: it kept it."""
    drift_m: float | None = None
    """Horizontal distance between the place where it first stopped after the last gate and the
    place at the end; None if it did not stop."""

    @property
    def has_finished(self) -> bool:
        """True if all gates were passed in order, without a crash."""
        return self.outcome == "finished"

    @property
    def gates_passed(self) -> int:
        """Number of gates passed in order."""
        return len(self.gate_times_s)

    @property
    def mean_speed_mps(self) -> float:
        """Mean speed over the whole flight, takeoff included."""
        return self.distance_m / self.flown_s if self.flown_s > 0 else 0.0

    @property
    def course_speed_mps(self) -> float | None:
        """Mean speed along the straight legs between the passed gates; None for fewer than two."""
        if self.gates_passed < 2:
            return None
        gates = make_course(self.course_seed).ahead(0, self.gates_passed)
        legs_m = [math.dist(a.center_ned_m, b.center_ned_m) for a, b in pairwise(gates)]
        return sum(legs_m) / (self.gate_times_s[-1] - self.gate_times_s[0])

    @property
    def course_s(self) -> float | None:
        """Time from first action to last gate; None unless finished."""
        return self.gate_times_s[-1] if self.has_finished and self.gate_times_s else None


class StickMeter:
    """``TickSink`` that measures the policy's stick activity."""

    def __init__(self) -> None:
        self.engaged_ns: int | None = None
        self._last: tuple[int, Action] | None = None
        self._travel = 0.0
        self._moved_ns = 0

    def emit(self, event: Event) -> None:
        """Add the stick change since the previous tick."""
        if not isinstance(event, Tick):
            return
        if event.trace is None or event.sent is None:
            self._last = None
            return
        if self.engaged_ns is None:
            self.engaged_ns = event.woke_ns
        last, self._last = self._last, (event.sent_ns, event.sent)
        if last is not None:
            self._moved_ns += event.sent_ns - last[0]
            self._travel += math.fsum(
                abs(now - before) for now, before in zip(event.sent, last[1], strict=True)
            )

    @property
    def rate_per_s(self) -> float | None:
        """Mean over the sticks of |change| per second; None before two actions in a row."""
        if not self._moved_ns:
            return None
        return self._travel / ACTION_DIM / (self._moved_ns / NS_PER_S)


class EpisodeInterruptedError(MavbridgeError):
    """Episode stopped before its end, so that it has no result."""


class Referee:
    """``TickSink`` that also watches the true vehicle, and sets ``stop`` at the end."""

    def __init__(
        self,
        clock: Clock,
        vehicle: SimulatedVehicle,
        *,
        max_time_s: float,
        run_out_s: float,
        stops: bool,
        should_stop: Callable[[], bool] | None,
    ) -> None:
        self._clock = clock
        self._vehicle = vehicle
        self._run_out_ns = round(run_out_s * NS_PER_S)
        self._standstill = Standstill() if stops else None
        self._stopped_ned_m: Vec3 | None = None
        self._max_time_ns = round(max_time_s * NS_PER_S)
        self._should_stop = should_stop
        self._start_ns = clock.now_ns()
        self._meter = StickMeter()
        self._release_reason: Reason | None = None
        self._lost: Reason | None = None
        self._outcome: Outcome | None = None
        self._end_ns = 0
        self._distance_m = 0.0
        self._gates_passed: tuple[GatePass, ...] = ()
        self._drift_m: float | None = None
        self.stop = threading.Event()

    def emit(self, event: Event) -> None:
        """Follow the bridge's ticks."""
        if isinstance(event, Tick) and not (self.stop.is_set() or self.has_stopped):
            self._release_reason = event.release_reason
            self._meter.emit(event)
            if self._standstill is not None:
                self._standstill.see(event)
            if self._meter.engaged_ns is not None:
                self._lost = self._lost or event.release_reason

    def watch(self) -> None:
        """Check the vehicle; called after each of its steps."""
        if self.stop.is_set():
            return
        self._outcome = self._find_outcome()
        log = self._vehicle.log
        if self._stopped_ned_m is None and log.next_gate is None and log.gates_passed:
            body = self._vehicle.ap.truth
            has_stopped = math.hypot(*body.velocity_ned_mps) < STOPPED_MPS
            self._stopped_ned_m = body.position_ned_m if has_stopped else None
        is_interrupted = self._should_stop is not None and self._should_stop()
        if self._outcome is not None or self._has_failed_to_engage or is_interrupted:
            self._end_ns = self._clock.now_ns()
            self._distance_m, self._gates_passed = log.distance_m, log.gates_passed
            if (stopped_ned_m := self._stopped_ned_m) is not None:
                end_ned_m = self._vehicle.ap.truth.position_ned_m
                self._drift_m = math.dist(stopped_ned_m[:2], end_ned_m[:2])
            self.stop.set()

    @property
    def has_stopped(self) -> bool:
        """True if the policy has stopped, as it does at the end."""
        return self._standstill is not None and self._standstill.has_lasted(self._clock.now_ns())

    @property
    def _has_failed_to_engage(self) -> bool:
        is_late = self._clock.now_ns() - self._start_ns > READY_NS
        return self._meter.engaged_ns is None and is_late

    def _find_outcome(self) -> Outcome | None:
        if (engaged_ns := self._meter.engaged_ns) is None:
            return None
        ap = self._vehicle.ap
        if (verdict := self._vehicle.log.verdict(ap.now_ns, self._run_out_ns)) is not None:
            return verdict
        if self.has_stopped and self._vehicle.log.next_gate is not None:
            return "stopped"
        if not ap.armed:  # where nobody takes the sticks, a stopped vehicle lands
            return "finished" if self.has_stopped else "disarmed"
        is_late = self._clock.now_ns() - engaged_ns >= self._max_time_ns
        return "timed out" if is_late else None

    def result(self, *, course_seed: int, seed: int) -> EpisodeResult:
        """Return the result of a flight that has ended.

        Raises:
            EpisodeInterruptedError: the flight was stopped before its end.
            PeerError: the policy never got the sticks.
        """
        if self._has_failed_to_engage:
            reason = self._release_reason or "images or states are older than their limits"
            raise PeerError(
                f"the policy did not get the sticks within {READY_NS // NS_PER_S} s: {reason}"
            )
        engaged_ns = self._meter.engaged_ns
        if self._outcome is None or engaged_ns is None:
            raise EpisodeInterruptedError(f"course {course_seed}: interrupted")
        offset_s = (engaged_ns - self._start_ns) / NS_PER_S
        return EpisodeResult(
            course_seed=course_seed,
            seed=seed,
            outcome=self._outcome,
            gates_total=self._vehicle.log.gates_total,
            gate_times_s=tuple(gate.t_s - offset_s for gate in self._gates_passed),
            flown_s=(self._end_ns - engaged_ns) / NS_PER_S,
            distance_m=self._distance_m,
            stick_rate_per_s=self._meter.rate_per_s,
            lost=self._lost,
            drift_m=self._drift_m,
        )
