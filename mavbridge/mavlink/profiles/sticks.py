"""Stick curves, and the map from a policy's sticks to a vehicle's that cause the same motion.

A curve gives the motion that a stick commands. The policy's curves come from its contract
(``StickGains``), the vehicle's from its parameters (`ardupilot_sticks`, `px4`). A stick is
mapped to a motion by the policy's curve, and back to a stick by the inverse of the vehicle's curve.
"""

import math
from collections.abc import Mapping
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
"""Tolerance for rounding of a difference at the limit."""


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

    def sticks(self, pitch_deg: float, roll_deg: float) -> tuple[float, float]:
        """Return the sticks for these leans."""
        pitch, roll = pitch_deg, roll_deg
        if self.is_tangent:
            pitch, roll = math.tan(math.radians(pitch_deg)), math.tan(math.radians(roll_deg))
        pitch, roll = _within(self.full, pitch, roll)
        return self.pitch.stick(pitch), self.roll.stick(roll)


def _within(full: float, pitch: float, roll: float) -> tuple[float, float]:
    """Shorten a vector to at most ``full``, keeping its direction."""
    length = math.hypot(pitch, roll)
    if length <= full:
        return pitch, roll
    return pitch * full / length, roll * full / length


class Extent(NamedTuple):
    """Motion at full stick of the policy and of the vehicle."""

    noun: str
    verb: str
    unit: str
    policy: Half
    vehicle: Half
    is_mapped: bool

    @property
    def shortfall(self) -> str | None:
        """Sentence if the vehicle falls short of the policy, else None."""
        most = self.vehicle.full
        if most >= self.policy.full * (1.0 - SAME_GAIN):
            return None
        return (
            f"full {self.noun} of the policy is {self.policy.full:.3g} {self.unit} and this "
            f"vehicle {self.verb} {most:.3g} {self.unit} at most ({self.vehicle.parameter}): "
            f"beyond {self.policy.travel(most):.2f} of the stick it does less"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class StickCurves:
    """Map of one policy's sticks to one vehicle's, in one flight mode.

    A stick without a map (None) passes unchanged, bit for bit: it means the same to both, or has no
    meaning from the policy's training.
    """

    throttle: tuple[Axis, Axis] | None = None
    """The policy's climb rate (m/s, + up) and the vehicle's."""
    yaw: tuple[Axis, Axis] | None = None
    """Yaw rates in degrees/s, + nose right."""
    lean: tuple[Lean, Lean] | None = None
    extents: tuple[Extent, ...] = ()
    unmapped: str | None = None
    """Why nothing is mapped although it should be, or None."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user at the start."""
        return tuple(filter(None, [self.unmapped, *(each.shortfall for each in self.extents)]))

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
    turn = Axis.even(Half(gains.yaw_rate_degps, gains.yaw_dead_zone))
    leans = Axis.even(Half(gains.lean_deg, gains.lean_dead_zone))
    leaning = Lean(leans, leans, gains.lean_deg)
    dead_zone = gains.throttle_dead_zone
    climbing = Axis(Half(gains.climb_mps, dead_zone), Half(gains.descent_mps, dead_zone))
    climbs = None if throttle is None or throttle.is_like(climbing) else (climbing, throttle)
    turns = None if yaw.is_like(turn) else (turn, yaw)
    lean_map = None if lean.is_like(leaning) else (leaning, lean)
    up, down = throttle or (None, None)
    leant = Half(lean.full_deg, parameter=lean.parameter)
    extents = (
        ("climb", "climbs", "m/s", climbing.above, up, climbs),
        ("descent", "descends", "m/s", climbing.below, down, climbs),
        ("yaw rate", "turns", "deg/s", turn.above, yaw.above, turns),
        ("lean", "leans", "deg", leans.above, leant, lean_map),
    )
    return StickCurves(
        throttle=climbs,
        yaw=turns,
        lean=lean_map,
        extents=tuple(
            Extent(noun, verb, unit, policy, vehicle, found is not None)
            for noun, verb, unit, policy, vehicle, found in extents
            if vehicle is not None
        ),
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
