"""The envelope of a flight: tilt, height, speed, distance, estimator, battery, landing."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Literal, NamedTuple, TypeAlias

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.rotation import tilt_rad
from mavbridge.core.vehicle import Reading, Telemetry, VehicleStatus

READING_PERSIST_NS = 50 * NS_PER_MS
"""Tilt and speed must be out for so long, by their own stamps: six readings at 100 Hz, two at 20 Hz
or less, so that one bad reading ends no flight."""
POSITION_PERSIST_NS = 300 * NS_PER_MS
"""Height and distance; 6 m at the fastest default speed."""
FLAG_PERSIST_NS = 600 * NS_PER_MS
"""Estimator, battery, landing: more than one message at 2 Hz."""
FRESH_NS = 500 * NS_PER_MS
"""An older attitude or velocity is not watched; the guard has its own, stricter limits of age."""

_Kind: TypeAlias = Literal["fault", "landed"]


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvelopeLimits:
    """Limits that a flight must stay inside of; 0 or infinity = not watched."""

    tilt_deg: float = 60.0
    """Between the vehicle's down and the world's; normal flight stays below 35."""
    height_m: float = 120.0
    """Above the estimator's origin; 120 m is the legal limit in most countries."""
    speed_mps: float = 20.0
    """In all three directions."""
    distance_m: float = 300.0
    """Horizontal, from the estimator's origin; about as far as a small vehicle can be seen."""
    estimator: bool = True
    """The estimator must not lose a position that it had."""
    battery: bool = True
    landing: bool = True
    """A landing ends the flight."""

    def widened(self, by: "EnvelopeLimits") -> "EnvelopeLimits":
        """The wider limit of each pair; a quantity that either does not watch is not watched."""
        wider: dict[str, float | bool] = {}
        for field in fields(self):
            one, other = getattr(self, field.name), getattr(by, field.name)
            wider[field.name] = max(one, other) if one and other else type(one)(0)
        return EnvelopeLimits(**wider)  # type: ignore[arg-type]


class EnvelopeInput(NamedTuple):
    """The vehicle at one tick, as the link's snapshot has it."""

    now_ns: int
    telemetry: Telemetry
    status: VehicleStatus


class EnvelopeExit(NamedTuple):
    """The end of a flight by its envelope."""

    kind: _Kind
    """fault, or landed: the flight is over, and nothing is wrong."""
    reason: Reason


class _Finding(NamedTuple):
    """One quantity at one tick."""

    name: str
    problem: Reason | None
    stamp_ns: int
    persist_ns: int


class Envelope:
    """Tells when the vehicle leaves its envelope, and which quantities it cannot watch.

    ``reset`` at every engagement: a lost position and a landing count only after the position was
    valid and the vehicle in the air.
    """

    def __init__(self, limits: EnvelopeLimits) -> None:
        self._limits = limits
        self._since_ns: dict[str, int] = {}
        """Stamp of the first of an unbroken row of problems, by quantity; at most seven."""
        self._had_position = False
        self._was_in_air = False
        self._unwatched: list[str] = []

    def reset(self) -> None:
        """Begin a flight."""
        self._since_ns.clear()
        self._had_position = self._was_in_air = False

    @property
    def unwatched(self) -> tuple[str, ...]:
        """Limits that could not be checked at the last tick, as sentences for the user."""
        return tuple(self._unwatched)

    def check(self, vehicle: EnvelopeInput) -> EnvelopeExit | None:
        """The first limit that was exceeded for long enough, or None."""
        self._unwatched.clear()
        found: EnvelopeExit | None = None
        for finding in self._findings(vehicle):
            if finding.problem is None:
                self._since_ns.pop(finding.name, None)
                continue
            since_ns = self._since_ns.setdefault(finding.name, finding.stamp_ns)
            if found is None and finding.stamp_ns - since_ns >= finding.persist_ns:
                kind: _Kind = "landed" if finding.name == "landing" else "fault"
                found = EnvelopeExit(kind, finding.problem)
        return found

    def _findings(self, vehicle: EnvelopeInput) -> Iterator[_Finding]:
        limits, telemetry, now_ns = self._limits, vehicle.telemetry, vehicle.now_ns
        if reading := self._fresh("tilt", limits.tilt_deg, telemetry.ned_from_body_wxyz, now_ns):
            problem = _beyond(
                "tilt", math.degrees(tilt_rad(reading.values)), limits.tilt_deg, "deg"
            )
            yield _Finding("tilt", problem, reading.arrived_ns, READING_PERSIST_NS)
        if reading := self._fresh("speed", limits.speed_mps, telemetry.velocity_ned_mps, now_ns):
            problem = _beyond("speed", math.hypot(*reading.values), limits.speed_mps, "m/s")
            yield _Finding("speed", problem, reading.arrived_ns, READING_PERSIST_NS)
        yield from self._position_findings(vehicle)
        yield from self._flag_findings(vehicle)

    def _fresh(
        self, name: str, limit: float, reading: Reading | None, now_ns: int
    ) -> Reading | None:
        """The reading if it is to be watched and can be."""
        if not _is_limit(limit):
            return None
        if reading is None or now_ns - reading.arrived_ns > FRESH_NS:
            self._ignore(name, "no fresh attitude" if name == "tilt" else "no valid velocity")
            return None
        return reading

    def _ignore(self, name: str, reason: str) -> None:
        """Note a quantity that has no data; what was out before has to be seen anew."""
        self._since_ns.pop(name, None)
        self._unwatched.append(f"{name} is not watched: {reason}")

    def _position_findings(self, vehicle: EnvelopeInput) -> Iterator[_Finding]:
        position = vehicle.status.position_ned_m
        for name, limit in (
            ("height", self._limits.height_m),
            ("distance", self._limits.distance_m),
        ):
            if not _is_limit(limit):
                continue
            if position is None:
                self._ignore(name, "no valid position")
                continue
            north_m, east_m, down_m = position
            value_m = -down_m if name == "height" else math.hypot(north_m, east_m)
            problem = _beyond(name, value_m, limit, "m")
            yield _Finding(name, problem, vehicle.now_ns, POSITION_PERSIST_NS)

    def _flag_findings(self, vehicle: EnvelopeInput) -> Iterator[_Finding]:
        limits, status, now_ns = self._limits, vehicle.status, vehicle.now_ns
        if limits.estimator:
            self._had_position |= status.is_position_valid is True
            if not self._had_position or status.is_position_valid is None:
                self._ignore("estimator", "it reports no valid position")
            lost = self._had_position and status.is_position_valid is False
            problem = because(Code.ESTIMATOR_LOST) if lost else None
            yield _Finding("estimator", problem, now_ns, FLAG_PERSIST_NS)
        if limits.battery:
            yield _Finding("battery", status.battery_problem, now_ns, FLAG_PERSIST_NS)
        if limits.landing:
            if status.is_landed is None:
                self._ignore("landing", "the vehicle does not say whether it is in the air")
            self._was_in_air |= status.armed and status.is_landed is False
            has_landed = self._was_in_air and status.armed and status.is_landed is True
            problem = because(Code.LANDED) if has_landed else None
            yield _Finding("landing", problem, now_ns, FLAG_PERSIST_NS)


def _is_limit(limit: float) -> bool:
    return 0 < limit < math.inf


def _beyond(name: str, value: float, limit: float, unit: str) -> Reason | None:
    if value <= limit:
        return None
    return because(Code.BEYOND, quantity=name, value=value, limit=limit, unit=unit)
