"""Decides when an episode is over, and how it went."""

import threading
from collections.abc import Callable

from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import MavbridgeError, PeerError
from mavbridge.core.records import Event, Tick
from mavbridge.simulation.result import EpisodeResult, Outcome, StickMeter
from sitl.simulated_vehicle import SimulatedVehicle

READY_NS = 30 * NS_PER_S
"""Most that an episode may take until the policy flies; a quick boot needs some 4 s."""


class EpisodeInterruptedError(MavbridgeError):
    """Somebody asked for the end of an episode that was not over."""


class Referee:
    """A ``TickSink`` that also looks at the true vehicle after each of its steps."""

    def __init__(
        self,
        clock: Clock,
        vehicle: SimulatedVehicle,
        *,
        max_time_s: float,
        should_stop: Callable[[], bool] | None,
    ) -> None:
        self._clock = clock
        self._vehicle = vehicle
        self._max_time_ns = round(max_time_s * NS_PER_S)
        self._should_stop = should_stop
        self._start_ns = clock.now_ns()
        self._meter = StickMeter()
        self._reason: str | None = None
        self._outcome: Outcome | None = None
        self._end_ns = 0
        self._distance_m = 0.0
        self.stop = threading.Event()
        """Set when the episode is over."""

    def emit(self, event: Event) -> None:
        """Follow what the bridge does."""
        if isinstance(event, Tick) and not self.stop.is_set():
            self._reason = event.release_reason
            self._meter.emit(event)

    def watch(self) -> None:
        """Look at the vehicle."""
        if self.stop.is_set():
            return
        self._outcome = self._judge()
        is_stuck = self._meter.engaged_ns is None and self._waited_ns > READY_NS
        if self._outcome is not None or is_stuck or (self._should_stop and self._should_stop()):
            self._end_ns = self._clock.now_ns()
            self._distance_m = self._vehicle.log.distance_m
            self.stop.set()

    @property
    def _waited_ns(self) -> int:
        return self._clock.now_ns() - self._start_ns

    def _judge(self) -> Outcome | None:
        if (engaged_ns := self._meter.engaged_ns) is None:
            return None
        ap = self._vehicle.ap
        if (verdict := self._vehicle.log.verdict(ap.now_ns)) is not None:
            return verdict
        if not ap.armed:
            return "disarmed"
        is_late = self._clock.now_ns() - engaged_ns >= self._max_time_ns
        return "timed out" if is_late else None

    def result(self, *, course_seed: int, seed: int) -> EpisodeResult:
        """How it went.

        Raises:
            EpisodeInterruptedError: it was not over when it was stopped.
            PeerError: the policy never got the sticks.
        """
        engaged_ns = self._meter.engaged_ns
        if self._outcome is None or engaged_ns is None:
            if self._waited_ns > READY_NS and engaged_ns is None:
                raise PeerError(
                    f"the policy did not get the sticks within {READY_NS // NS_PER_S} s: "
                    f"{self._reason}"
                )
            raise EpisodeInterruptedError(f"course {course_seed}: interrupted")
        log = self._vehicle.log
        offset_s = (engaged_ns - self._start_ns) / NS_PER_S
        return EpisodeResult(
            course_seed=course_seed,
            seed=seed,
            outcome=self._outcome,
            gates_total=log.gates_total,
            gate_times_s=tuple(gate.t_s - offset_s for gate in log.gates_passed),
            flown_s=(self._end_ns - engaged_ns) / NS_PER_S,
            distance_m=self._distance_m,
            stick_rate_per_s=self._meter.rate_per_s,
        )
