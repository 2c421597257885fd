"""Flight envelope: tilt, height, speed, distance, estimator, battery, landing."""

import math
from dataclasses import dataclass

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.rotation import tilt_rad
from mavbridge.core.vehicle import Telemetry, VehicleStatus

READING_NS = 50 * NS_PER_MS
"""Debounce time of tilt and speed, by the readings' timestamps: six readings at 100 Hz, two at 20
Hz or less, so that one bad reading does not end a flight."""
POSITION_NS = 300 * NS_PER_MS
"""Debounce time of height and distance; 6 m at the default speed limit."""
FLAG_NS = 600 * NS_PER_MS
"""Debounce time of estimator, battery and landing: more than one message at 2 Hz."""
FRESH_NS = 500 * NS_PER_MS
"""Oldest attitude and velocity that are checked; the policy's inputs have stricter age limits."""
_WATCHED = {
    "tilt": ("deg", READING_NS, "no fresh attitude"),
    "speed": ("m/s", READING_NS, "no valid velocity"),
    "height": ("m", POSITION_NS, "no valid position"),
    "distance": ("m", POSITION_NS, "no valid position"),
}
"""By quantity: unit, debounce time, and what is missing where it cannot be watched."""


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
        limits, position = self._limits, status.position_ned_m
        attitude, velocity = telemetry.ned_from_body_wxyz, telemetry.velocity_ned_mps
        if attitude is None or now_ns - attitude.arrived_ns > FRESH_NS:
            self._watch("tilt", None, limits.tilt_deg, now_ns)
        else:
            tilt_deg = math.degrees(tilt_rad(attitude.values))
            self._watch("tilt", tilt_deg, limits.tilt_deg, attitude.arrived_ns)
        if velocity is None or now_ns - velocity.arrived_ns > FRESH_NS:
            self._watch("speed", None, limits.speed_mps, now_ns)
        else:
            speed_mps = math.hypot(*velocity.values)
            self._watch("speed", speed_mps, limits.speed_mps, velocity.arrived_ns)
        distance_m = None if position is None else math.hypot(position[0], position[1])
        self._watch("height", status.height_m, limits.height_m, now_ns)
        self._watch("distance", distance_m, limits.distance_m, now_ns)
        self._check_flags(status, now_ns)
        return self._found

    def _watch(self, name: str, value: float | None, limit: float, stamp_ns: int) -> None:
        """Compare one quantity with its limit. ``value``: None without valid data."""
        unit, persist_ns, lack = _WATCHED[name]
        if not 0 < limit < math.inf:
            return
        if value is None:
            self._ignore(name, lack)
            return
        problem = because(Code.BEYOND, quantity=name, value=value, limit=limit, unit=unit)
        self._note(name, problem if value > limit else None, stamp_ns, persist_ns)

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

    def _check_flags(self, status: VehicleStatus, now_ns: int) -> None:
        self._had_position |= status.is_position_valid is True
        if not self._had_position or status.is_position_valid is None:
            self._ignore("estimator", "it reports no valid position")
        lost = self._had_position and status.is_position_valid is False
        self._note("estimator", because(Code.ESTIMATOR_LOST) if lost else None, now_ns, FLAG_NS)
        self._note("battery", status.battery_problem, now_ns, FLAG_NS)
        if not status.is_charge_known:
            self._ignore("min_battery", "the vehicle reports no charge")
        if status.is_landed is None:
            self._ignore("landing", "the vehicle does not say whether it is in the air")
        self._was_in_air |= status.armed and status.is_landed is False
        has_landed = self._was_in_air and status.armed and status.is_landed is True
        self._note("landing", because(Code.LANDED) if has_landed else None, now_ns, FLAG_NS)
