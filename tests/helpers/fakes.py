"""Test doubles: a virtual clock, a scripted camera, a recording sink, a vehicle in memory."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.records import Event, Frame, Tick, VisionTick
from mavbridge.core.vehicle import (
    Decision,
    LinkSnapshot,
    Reading,
    Release,
    Sticks,
    Telemetry,
    VehicleStatus,
)

START_NS = 1_000 * NS_PER_S


class FakeClock:
    """Moves only when told to, or when somebody sleeps; sleeps may overshoot."""

    def __init__(self, start_ns: int = START_NS, oversleep_ns: int = 0) -> None:
        self._now_ns = start_ns
        self.oversleep_ns = oversleep_ns

    def now_ns(self) -> int:
        return self._now_ns

    def advance_ns(self, duration_ns: int) -> None:
        self._now_ns += duration_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        if deadline_ns > self._now_ns:
            self._now_ns = deadline_ns + self.oversleep_ns


class ListSink:
    """Keeps every event."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def emit(self, event: Event) -> None:
        self.events.append(event)

    @property
    def ticks(self) -> list[Tick]:
        return [event for event in self.events if isinstance(event, Tick)]

    @property
    def visions(self) -> list[VisionTick]:
        return [event for event in self.events if isinstance(event, VisionTick)]


class ScriptedCamera:
    """A camera on a virtual clock: frames at given times, newest wins, the passed-over counted."""

    def __init__(self, clock: FakeClock, captured_ns: list[int]) -> None:
        self._clock = clock
        self._pending = list(enumerate(captured_ns, start=1))
        self.dropped_frames = 0
        self.is_closed = False

    def read(self, timeout_ns: int) -> Frame | None:
        deadline_ns = self._clock.now_ns() + timeout_ns
        ready = [item for item in self._pending if item[1] <= self._clock.now_ns()]
        if not ready:
            if not self._pending or self._pending[0][1] > deadline_ns:
                self._clock.sleep_until_ns(deadline_ns)
                return None
            self._clock.sleep_until_ns(self._pending[0][1])
            ready = self._pending[:1]
        self._pending = self._pending[len(ready) :]
        self.dropped_frames += len(ready) - 1
        frame_id, captured_ns = ready[-1]
        rgb = np.zeros((4, 4, 3), dtype=np.uint8)
        return Frame(frame_id=frame_id, captured_ns=captured_ns, rgb=rgb)

    def close(self) -> None:
        self.is_closed = True


def level_telemetry(arrived_ns: int) -> Telemetry:
    """Level hover facing north."""
    return Telemetry(
        ned_from_body_wxyz=Reading(arrived_ns, (1.0, 0.0, 0.0, 0.0)),
        rate_body_radps=Reading(arrived_ns, (0.0, 0.0, 0.0)),
        velocity_ned_mps=Reading(arrived_ns, (0.0, 0.0, 0.0)),
        specific_force_body_mps2=Reading(arrived_ns, (0.0, 0.0, -9.80665)),
    )


@dataclass
class FakeLink:
    """A vehicle that obeys at once; fields may be changed between ticks."""

    clock: FakeClock
    armed: bool = True
    mode: str = "ALT_HOLD"
    problem: str | None = None
    echo_confirmed: bool = True
    rc_sticks: Sticks | None = None
    telemetry_age_ns: int = 2 * NS_PER_MS
    telemetry: Telemetry | None = None
    decisions: list[tuple[int, Decision]] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    on_poll: Callable[["FakeLink"], None] | None = None
    hand_backs: int = 0
    attitudes_ns: list[int] = field(default_factory=list)
    """Arrivals, for a loop that is paced by them."""

    def poll(self) -> LinkSnapshot:
        if self.on_poll is not None:
            self.on_poll(self)
        now_ns = self.clock.now_ns()
        telemetry = self.telemetry or level_telemetry(now_ns - self.telemetry_age_ns)
        status = VehicleStatus(
            mode=self.mode,
            armed=self.armed,
            rc_sticks=self.rc_sticks,
            rc_arrived_ns=now_ns if self.rc_sticks else None,
        )
        return LinkSnapshot(
            telemetry=telemetry,
            status=status,
            problem=self.problem,
            echo_confirmed=self.echo_confirmed,
        )

    def service(self) -> None:
        pass

    def wait_for_attitude(self, *, newer_than_ns: int, until_ns: int) -> int:
        arrivals = (t for t in self.attitudes_ns if t > newer_than_ns)
        self.clock.sleep_until_ns(min(next(arrivals, until_ns), until_ns))
        return max((t for t in self.attitudes_ns if t <= self.clock.now_ns()), default=0)

    def send(self, decision: Decision) -> Sticks | None:
        self.decisions.append((self.clock.now_ns(), decision))
        return None if isinstance(decision, Release) else decision.sticks

    def hand_back(self) -> None:
        self.hand_backs += 1

    def set_mode(self, mode: str) -> None:
        self.asked.append(f"mode {mode}")

    def arm(self) -> None:
        self.asked.append("arm")

    def close(self) -> None:
        self.problem = "closed"


def without(telemetry: Telemetry, field_name: str) -> Telemetry:
    """The same telemetry with one quantity never received."""
    return replace(telemetry, **{field_name: None})
