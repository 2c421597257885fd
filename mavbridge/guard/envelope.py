"""Flight envelope: tilt, height, speed, distance, estimator, battery, landing."""

import math
from dataclasses import dataclass, fields

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.rotation import tilt_rad
from mavbridge.core.vehicle import Telemetry, VehicleStatus

READING_PERSIST_NS = 50 * NS_PER_MS
"""Debounce time of tilt and speed, by the readings' timestamps: six readings at 100 Hz, two at 20
Hz or less, so that one bad reading does not end a flight."""
POSITION_PERSIST_NS = 300 * NS_PER_MS
"""Debounce time of height and distance; 6 m at the default speed limit."""
FLAG_PERSIST_NS = 600 * NS_PER_MS
"""Debounce time of estimator, battery and landing: more than one message at 2 Hz."""
FRESH_NS = 500 * NS_PER_MS
"""Oldest attitude and velocity that are checked; the policy's inputs have stricter age limits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvelopeLimits:
    """Limits of the flight envelope; 0 or infinity: not watched."""

    tilt_deg: float = 60.0
    """Angle between the vehicle's down axis and the world's; below 35 in normal flight."""
    height_m: float = 120.0
    """Above the estimator's origin; 120 m is the legal limit in most countries."""
    speed_mps: float = 20.0
    """Speed in three dimensions."""
    distance_m: float = 300.0
    """Horizontal, from the estimator's origin; about as far as a small vehicle is visible."""
    estimator: bool = True
    """Fault if the estimator loses a position that it had."""
    battery: bool = True
    landing: bool = True
    """A landing ends the flight."""

    def widened(self, by: "EnvelopeLimits") -> "EnvelopeLimits":
        """Return the wider limit of each pair; a quantity unwatched in either is unwatched."""
        wider: dict[str, float | bool] = {}
        for field in fields(self):
            one, other = getattr(self, field.name), getattr(by, field.name)
            wider[field.name] = max(one, other) if one and other else type(one)(0)
        return EnvelopeLimits(**wider)  # type: ignore[arg-type]


class Envelope:
    """Detects when the vehicle leaves its envelope, and which quantities cannot be watched.

    Call ``reset`` at every engagement: a lost position counts only after the position was valid, a
    landing only after the vehicle was in the air.
    """

    def __init__(self, limits: EnvelopeLimits) -> None:
        self._limits = limits
        self._since_ns: dict[str, int] = {}
        """Timestamp at which a problem began that has lasted since, by quantity; at most seven."""
        self._had_position = False
        self._was_in_air = False
        self.unwatched: list[str] = []
        """Limits that could not be checked at the last tick, as sentences for the user."""
        self._found: Reason | None = None
        """First limit exceeded at this tick."""

    def reset(self) -> None:
        """Start the checks of a new flight."""
        self._since_ns.clear()
        self._had_position = self._was_in_air = False

    def check(self, now_ns: int, telemetry: Telemetry, status: VehicleStatus) -> Reason | None:
        """Return the first limit that has been exceeded for its debounce time, or None.

        A landing, ``Code.LANDED``, is a normal end; every other reason is a fault.
        """
        self.unwatched.clear()
        self._found = None
        self._check_motion(telemetry, now_ns)
        self._check_position(status.position_ned_m, now_ns)
        self._check_flags(status, now_ns)
        return self._found

    def _note(self, name: str, problem: Reason | None, stamp_ns: int, persist_ns: int) -> None:
        """Note the state of one quantity; ``stamp_ns`` counts for its debounce time."""
        if problem is None:
            self._since_ns.pop(name, None)
            return
        since_ns = self._since_ns.setdefault(name, stamp_ns)
        if self._found is None and stamp_ns - since_ns >= persist_ns:
            self._found = problem

    def _ignore(self, name: str, reason: str) -> None:
        """Note a quantity without data, and restart its debounce."""
        self._since_ns.pop(name, None)
        self.unwatched.append(f"{name} is not watched: {reason}")

    def _check_motion(self, telemetry: Telemetry, now_ns: int) -> None:
        oldest_ns, limits = now_ns - FRESH_NS, self._limits
        if _is_limit(limits.tilt_deg):
            attitude = telemetry.ned_from_body_wxyz
            if attitude is None or attitude.arrived_ns < oldest_ns:
                self._ignore("tilt", "no fresh attitude")
            else:
                tilt_deg = math.degrees(tilt_rad(attitude.values))
                problem = _beyond("tilt", tilt_deg, limits.tilt_deg, "deg")
                self._note("tilt", problem, attitude.arrived_ns, READING_PERSIST_NS)
        if _is_limit(limits.speed_mps):
            velocity = telemetry.velocity_ned_mps
            if velocity is None or velocity.arrived_ns < oldest_ns:
                self._ignore("speed", "no valid velocity")
            else:
                speed_mps = math.hypot(*velocity.values)
                problem = _beyond("speed", speed_mps, limits.speed_mps, "m/s")
                self._note("speed", problem, velocity.arrived_ns, READING_PERSIST_NS)

    def _check_position(
        self, position_ned_m: tuple[float, float, float] | None, now_ns: int
    ) -> None:
        watched = (("height", self._limits.height_m), ("distance", self._limits.distance_m))
        for name, limit_m in watched:
            if not _is_limit(limit_m):
                continue
            if position_ned_m is None:
                self._ignore(name, "no valid position")
                continue
            north_m, east_m, down_m = position_ned_m
            value_m = -down_m if name == "height" else math.hypot(north_m, east_m)
            problem = _beyond(name, value_m, limit_m, "m")
            self._note(name, problem, now_ns, POSITION_PERSIST_NS)

    def _check_flags(self, status: VehicleStatus, now_ns: int) -> None:
        limits = self._limits
        if limits.estimator:
            self._had_position |= status.is_position_valid is True
            if not self._had_position or status.is_position_valid is None:
                self._ignore("estimator", "it reports no valid position")
            lost = self._had_position and status.is_position_valid is False
            problem = because(Code.ESTIMATOR_LOST) if lost else None
            self._note("estimator", problem, now_ns, FLAG_PERSIST_NS)
        if limits.battery:
            self._note("battery", status.battery_problem, now_ns, FLAG_PERSIST_NS)
        if limits.landing:
            if status.is_landed is None:
                self._ignore("landing", "the vehicle does not say whether it is in the air")
            self._was_in_air |= status.armed and status.is_landed is False
            has_landed = self._was_in_air and status.armed and status.is_landed is True
            problem = because(Code.LANDED) if has_landed else None
            self._note("landing", problem, now_ns, FLAG_PERSIST_NS)


def _is_limit(limit: float) -> bool:
    return 0 < limit < math.inf


def _beyond(name: str, value: float, limit: float, unit: str) -> Reason | None:
    if value <= limit:
        return None
    return because(Code.BEYOND, quantity=name, value=value, limit=limit, unit=unit)
