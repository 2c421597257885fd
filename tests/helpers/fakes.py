"""Test doubles: a virtual clock, a recording sink, a vehicle in memory."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from helpers.guard_facts import AIRBORNE, COPTER_MODES
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.records import Event, Tick, VisionTick
from mavbridge.core.vehicle import (
    Action,
    ActionMeaning,
    Decision,
    LinkArrivals,
    LinkSnapshot,
    Outlet,
    Output,
    Reading,
    Release,
    Sample,
    Telemetry,
    VehicleStatus,
)

START_NS = 1_000 * NS_PER_S


class FakeClock:
    """Clock that moves only when told to, or when code sleeps; sleeps can overshoot."""

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


AIRBORNE_STATUS = replace(AIRBORNE.status, rc_channels_us=(), rc_arrived_ns=START_NS)
"""Armed in ALT_HOLD, 10 m up, with a receiver whose sticks are centred."""


def level_telemetry(arrived_ns: int) -> Telemetry:
    """Return a level hover facing north."""
    return Telemetry(
        ned_from_body_wxyz=Reading(arrived_ns, (1.0, 0.0, 0.0, 0.0)),
        rate_body_radps=Reading(arrived_ns, (0.0, 0.0, 0.0)),
        velocity_ned_mps=Reading(arrived_ns, (0.0, 0.0, 0.0)),
        specific_force_body_mps2=Reading(arrived_ns, (0.0, 0.0, -9.80665)),
    )


class FakeLink:
    """The guard's link to a vehicle in memory, which obeys at once."""

    autopilot = "fake 1.0"
    is_release_owed = False

    def __init__(self, clock: Clock, **status: Any) -> None:
        self._clock = clock
        self._samples: tuple[Sample, ...] = ()
        self._telemetry = Telemetry()
        self.status: VehicleStatus | None = replace(AIRBORNE_STATUS, **status)
        self.modes = COPTER_MODES
        self.texts: list[str] = []
        self.is_engaged = False
        self.is_restored = True
        self.commands = self
        self.decisions: list[tuple[int, Decision]] = []
        self.requests: list[str] = []
        self.announced: list[str] = []
        self.transmitted: list[tuple[int, str]] = []
        """Last words that were sent, as text."""
        self.outlet = Outlet(1, 7, ("127.0.0.1", 1))
        self.services = 0
        self.restores = 0
        self.on_send: Callable[[], None] = lambda: None

    def measure(self, *, age_ns: int = 0) -> None:
        """Send the vehicle's state, which arrives now and happened ``age_ns`` ago."""
        level = level_telemetry(self._clock.now_ns())
        self._telemetry = Telemetry(
            **{s.quantity: s.reading._replace(delay_ns=age_ns) for s in samples_of(level)}
        )
        self._samples += samples_of(self._telemetry)

    def change(self, **status: Any) -> None:
        assert self.status is not None
        self.status = replace(self.status, **status)

    def receive(self) -> LinkArrivals:
        samples, self._samples = self._samples, ()
        return LinkArrivals(samples, ())

    def snapshot(self) -> LinkSnapshot:
        texts, self.texts = tuple(self.texts), []
        status = self.status
        if status is not None and status.rc_arrived_ns is not None:
            status = replace(status, rc_arrived_ns=self._clock.now_ns())
        holds = bool(self.decisions) and not isinstance(self.decisions[-1][1], Release)
        return LinkSnapshot(
            telemetry=self._telemetry,
            status=status,
            problem=None,
            echo_confirmed=True,
            is_released=not holds,
            modes=self.modes,
            texts=texts,
        )

    def send_before_action(self) -> None:
        pass

    def begin_flight(self, meaning: ActionMeaning, output: Output | None, **watches: bool) -> None:
        pass

    def send(self, decision: Decision, decided_ns: int) -> Action | None:
        self.on_send()
        self.decisions.append((self._clock.now_ns(), decision))
        return None if isinstance(decision, Release) else decision

    def service(self) -> None:
        self.services += 1

    def set_mode(self, mode: str) -> None:
        self.requests.append(f"mode {mode}")
        self.change(mode=mode)

    def announce(self, text: str) -> None:
        self.announced.append(text)

    def rehearse(
        self, plan: Iterable[tuple[int, Decision | None, str | None]]
    ) -> tuple[tuple[int, bytes], ...]:
        """Return each decision and each mode as text."""
        return tuple(
            (after_ns, str(part).encode())
            for after_ns, *parts in plan
            for part in parts
            if part is not None
        )

    def transmit(self, packet: bytes) -> bool:
        self.on_send()
        self.transmitted.append((self._clock.now_ns(), packet.decode()))
        return True

    def restore(self) -> bool:
        self.restores += 1
        return self.is_restored


def without(telemetry: Telemetry, field_name: str) -> Telemetry:
    """Return the telemetry as if one quantity had never been received."""
    return telemetry._replace(**{field_name: None})


def samples_of(telemetry: Telemetry) -> tuple[Sample, ...]:
    """Return all readings of it, as the guard sends them."""
    known = telemetry._asdict().items()
    return tuple(Sample(name, reading) for name, reading in known if reading is not None)
