"""Stick curves, and the map from a policy's sticks to a vehicle's that cause the same motion.

A curve gives the motion that a stick commands. The policy's curves come from its contract
(``StickGains``), the vehicle's from its parameters (`ardupilot_sticks`, `px4_sticks`). A stick is
mapped to a motion by the policy's curve, and back to a stick by the inverse of the vehicle's curve.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

from mavbridge.core.vehicle import StickGains, Sticks

SAME_GAIN = 0.01
"""A stick is not mapped if the vehicle's motion at full stick is within this fraction of the
policy's, and the dead zones differ by at most this fraction of the travel (see also SAME_END)."""
SAME_END = 0.1
"""Largest gap in travel between full motion and the stop of a stick that is not mapped. ArduPilot's
throttle has one at the bottom (RC3_DZ, 0.06 by default), also for the policies trained on it."""
MAX_DEAD_ZONE = 0.9
_ROUNDING = 1e-9
"""Tolerance for rounding of a motion at the limit."""


class Bend(Protocol):
    """Increasing curve from [0, 1] to [0, 1], with fixed ends."""

    def bent(self, share: float) -> float:
        """Return the fraction of the motion at this fraction of the stick."""

    def straightened(self, share: float) -> float:
        """Return the fraction of the stick for this fraction of the motion."""


class Half(NamedTuple):
    """Motion over one half of a stick's travel, which is 0 at the centre and 1 at the stop."""

    full: float
    """Largest motion."""
    start: float = 0.0
    """Travel at which motion begins."""
    end: float = 1.0
    """Travel from which the motion is full."""
    bend: Bend | None = None
    """None: linear from ``start`` to ``end``."""
    parameter: str = ""
    """The vehicle's parameter behind ``full``."""

    def motion(self, travel: float) -> float:
        """Return the motion at this travel."""
        if travel <= self.start:
            return 0.0
        if travel >= self.end:
            return self.full
        share = (travel - self.start) / (self.end - self.start)
        # Rounding may push the fraction beyond 1, here and in the inverse.
        return self.full * min(share if self.bend is None else self.bend.bent(share), 1.0)

    def travel(self, motion: float) -> float:
        """Return the travel for this motion: 0 for none, ``end`` for full motion or more."""
        if motion <= 0.0:
            return 0.0
        if motion >= self.full:
            return self.end
        share = motion / self.full
        if self.bend is not None:
            share = self.bend.straightened(share)
        return min(self.start + share * (self.end - self.start), self.end)

    def is_like(self, policy: "Half") -> bool:
        """True if this half is so close to the policy's that its sticks need no mapping."""
        return (
            self.bend is None
            and abs(self.full - policy.full) <= SAME_GAIN * policy.full
            and abs(self.start - policy.start) <= SAME_GAIN + _ROUNDING
            and abs(self.end - policy.end) <= SAME_END
        )


class Axis(NamedTuple):
    """Both halves of one stick."""

    above: Half
    """Stick > 0."""
    below: Half

    def motion(self, stick: float) -> float:
        """Return the motion, with the stick's sign."""
        return self.above.motion(stick) if stick >= 0.0 else -self.below.motion(-stick)

    def stick(self, motion: float) -> float:
        """Return the stick for a motion."""
        return self.above.travel(motion) if motion >= 0.0 else -self.below.travel(-motion)

    def is_like(self, policy: "Axis") -> bool:
        """True if both halves are close to the policy's."""
        return self.above.is_like(policy.above) and self.below.is_like(policy.below)

    @classmethod
    def even(cls, half: Half) -> "Axis":
        """Return an axis with this half in both directions."""
        return cls(half, half)


class AxisMap(NamedTuple):
    """Map of the throttle (m/s, + up) or the yaw (degrees/s, + nose right)."""

    policy: Axis
    vehicle: Axis

    def saturates(self, stick: float) -> bool:
        """True if the policy's stick demands more than the vehicle can do."""
        motion = self.policy.motion(stick)
        half = self.vehicle.above if motion >= 0.0 else self.vehicle.below
        return abs(motion) > half.full * (1.0 + _ROUNDING)


class Lean(NamedTuple):
    """Pitch and roll; their combined lean is limited to a circle."""

    pitch: Axis
    """Unit of ``pitch``, ``roll`` and ``full``: degrees, or the tangent of the lean."""
    roll: Axis
    full: float
    is_tangent: bool = False
    """True if sticks command an acceleration, and so the tangent of a lean."""
    parameter: str = ""

    @property
    def full_deg(self) -> float:
        """Largest lean."""
        return math.degrees(math.atan(self.full)) if self.is_tangent else self.full

    def is_like(self, policy: "Lean") -> bool:
        """True if the lean is so close to the policy's that its sticks need no mapping."""
        is_near = self.pitch.is_like(policy.pitch) and self.roll.is_like(policy.roll)
        return not self.is_tangent and is_near

    def motion_deg(self, pitch: float, roll: float) -> tuple[float, float]:
        """Return the leans for these sticks."""
        pitch, roll = _within(self.full, self.pitch.motion(pitch), self.roll.motion(roll))
        if self.is_tangent:
            return math.degrees(math.atan(pitch)), math.degrees(math.atan(roll))
        return pitch, roll

    def in_own_unit(self, pitch_deg: float, roll_deg: float) -> tuple[float, float]:
        """Return leans in the unit of ``full``."""
        if self.is_tangent:
            return math.tan(math.radians(pitch_deg)), math.tan(math.radians(roll_deg))
        return pitch_deg, roll_deg

    def sticks(self, pitch_deg: float, roll_deg: float) -> tuple[float, float]:
        """Return the sticks for these leans."""
        pitch, roll = _within(self.full, *self.in_own_unit(pitch_deg, roll_deg))
        return self.pitch.stick(pitch), self.roll.stick(roll)


class LeanMap(NamedTuple):
    """Map of pitch and roll."""

    policy: Lean
    vehicle: Lean

    def saturates(self, pitch: float, roll: float) -> bool:
        """True if the policy's sticks demand more lean than the vehicle has."""
        asked = self.vehicle.in_own_unit(*self.policy.motion_deg(pitch, roll))
        return math.hypot(*asked) > self.vehicle.full * (1.0 + _ROUNDING)


def _within(full: float, pitch: float, roll: float) -> tuple[float, float]:
    """Shorten a vector to at most ``full``, keeping its direction."""
    length = math.hypot(pitch, roll)
    if length <= full:
        return pitch, roll
    return pitch * full / length, roll * full / length


Quantity = Literal["climb", "descent", "yaw rate", "lean"]


@dataclass(frozen=True, slots=True, kw_only=True)
class StickCurves:
    """Map of one policy's sticks to one vehicle's, in one flight mode.

    A stick without a map (None) passes unchanged, bit for bit: it means the same to both, or has no
    meaning from the policy's training.
    """

    throttle: AxisMap | None = None
    yaw: AxisMap | None = None
    lean: LeanMap | None = None
    shortfalls: tuple[tuple[Quantity, str], ...] = ()
    """Quantities in which the vehicle falls short of the policy, each with a sentence."""
    unmapped: str | None = None
    """Why nothing is mapped although it should be, or None."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user at the start."""
        return (*filter(None, [self.unmapped]), *(text for _, text in self.shortfalls))

    @property
    def is_identity(self) -> bool:
        """True if no stick is changed."""
        return self.throttle is None and self.yaw is None and self.lean is None

    def to_vehicle(self, sticks: Sticks) -> Sticks:
        """Return the vehicle's sticks for the policy's; centred within the policy's dead zone."""
        return self._mapped(sticks, 1)

    def to_policy(self, sticks: Sticks) -> Sticks:
        """Return the policy's sticks for the motion that the vehicle's sticks cause.

        The inverse of ``to_vehicle``, for sticks as sent and for the pilot's. Motion beyond the
        policy's range becomes its full stick.
        """
        return self._mapped(sticks, -1)

    def _mapped(self, sticks: Sticks, order: Literal[1, -1]) -> Sticks:
        """Map by each pair of curves, from the first to the second, or back (-1)."""
        if self.is_identity:
            return sticks
        throttle, yaw, pitch, roll = sticks
        if self.throttle is not None:
            before, after = self.throttle[::order]
            throttle = after.stick(before.motion(throttle))
        if self.yaw is not None:
            before, after = self.yaw[::order]
            yaw = after.stick(before.motion(yaw))
        if self.lean is not None:
            leaning, leant = self.lean[::order]
            pitch, roll = leant.sticks(*leaning.motion_deg(pitch, roll))
        return Sticks(throttle=throttle, yaw=yaw, pitch=pitch, roll=roll)

    def saturated(self, sticks: Sticks) -> tuple[str, ...]:
        """Return the names of sticks that demand more than the vehicle can do, in Sticks' order."""
        names: tuple[str, ...] = ()
        if self.throttle is not None and self.throttle.saturates(sticks.throttle):
            names += ("throttle",)
        if self.yaw is not None and self.yaw.saturates(sticks.yaw):
            names += ("yaw",)
        if self.lean is not None and self.lean.saturates(sticks.pitch, sticks.roll):
            motion = self.lean.policy.pitch.motion
            names += ("pitch",) if motion(sticks.pitch) else ()
            names += ("roll",) if motion(sticks.roll) else ()
        return names


IDENTITY = StickCurves()


def curves_between(
    gains: StickGains, *, throttle: Axis | None, yaw: Axis, lean: Lean
) -> StickCurves:
    """Return the map from a policy's sticks to a vehicle's; sticks that need none stay unmapped.

    Args:
        gains: meaning of the policy's sticks.
        throttle: climb rate [m/s] of the vehicle, + up; None if the stick has another meaning.
        yaw: yaw rate [degrees/s], + nose right.
        lean: lean of the vehicle.
    """
    turns = AxisMap(Axis.even(Half(gains.yaw_rate_degps, gains.yaw_dead_zone)), yaw)
    leans = Axis.even(Half(gains.lean_deg, gains.lean_dead_zone))
    leaning = LeanMap(Lean(leans, leans, gains.lean_deg), lean)
    climbs = None
    if throttle is not None:
        dead_zone = gains.throttle_dead_zone
        climb, descent = Half(gains.climb_mps, dead_zone), Half(gains.descent_mps, dead_zone)
        climbs = AxisMap(Axis(climb, descent), throttle)
    return StickCurves(
        throttle=None if climbs is None or climbs.vehicle.is_like(climbs.policy) else climbs,
        yaw=None if yaw.is_like(turns.policy) else turns,
        lean=None if lean.is_like(leaning.policy) else leaning,
        shortfalls=tuple(_notes(climbs, turns, leaning)),
    )


def _notes(throttle: AxisMap | None, yaw: AxisMap, lean: LeanMap) -> Iterator[tuple[Quantity, str]]:
    if throttle is not None:
        up, down = throttle.vehicle
        yield from _note("climb", "climbs", "m/s", throttle.policy.above, up.full, up.parameter)
        yield from _note(
            "descent", "descends", "m/s", throttle.policy.below, down.full, down.parameter
        )
    right = yaw.vehicle.above
    yield from _note("yaw rate", "turns", "deg/s", yaw.policy.above, right.full, right.parameter)
    policy, vehicle = lean
    yield from _note(
        "lean", "leans", "deg", policy.pitch.above, vehicle.full_deg, vehicle.parameter
    )


def _note(
    noun: Quantity, verb: str, unit: str, policy: Half, most: float, parameter: str
) -> Iterator[tuple[Quantity, str]]:
    """Yield a sentence if the vehicle falls short of the policy's full stick."""
    if most < policy.full * (1.0 - SAME_GAIN):
        yield (
            noun,
            f"full {noun} of the policy is {policy.full:.3g} {unit} and this vehicle {verb} "
            f"{most:.3g} {unit} at most ({parameter}): beyond {policy.travel(most):.2f} of the "
            "stick it does less",
        )


def unusable(
    values: Mapping[str, float], *, needed: tuple[str, ...], positive: tuple[str, ...]
) -> StickCurves | None:
    """Return an empty map that says why, if parameters are missing or invalid; else None."""
    as_they_are = "the policy's sticks go to the vehicle as they are, whatever they mean to it"
    if missing := [name for name in needed if name not in values]:
        return StickCurves(unmapped=f"{as_they_are}: it did not send {', '.join(missing)}")
    if bad := [f"{name} is {values[name]:g}" for name in positive if not values[name] > 0.0]:
        return StickCurves(unmapped=f"{as_they_are}: {', '.join(bad)}")
    return None
