"""Sticks that make one vehicle do what a policy means by its own: curves, and the map between them.

A curve says how much motion a stick asks for. The policy's come from its contract (``StickGains``),
the vehicle's from its parameters (`ardupilot_sticks`, `px4_sticks`). A stick is mapped by the
policy's curve to a motion, and by the inverse of the vehicle's to the stick that asks for it there.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

from mavbridge.core.vehicle import StickGains, Sticks

SAME_GAIN = 0.01
"""A stick is not mapped where the vehicle's motion at full stick is within this share of the
policy's, and its dead zone within this share of the travel."""
SAME_END = 0.1
"""And where the full motion is reached within this share of the travel before the stop: ArduPilot's
throttle has its bottom there (RC3_DZ, 0.06 by default), also for the policies trained on it."""
MAX_DEAD_ZONE = 0.9
_ROUNDING = 1e-9
"""What float arithmetic may add to a motion that is just within reach."""


class Bend(Protocol):
    """A curve from [0, 1] to [0, 1], rising, with its ends where they are."""

    def bent(self, share: float) -> float:
        """Share of the motion at this share of the stick."""

    def straightened(self, share: float) -> float:
        """Inverse of ``bent``."""


class Half(NamedTuple):
    """Motion over one half of a stick's travel; the travel is 0 at the centre and 1 at the stop."""

    full: float
    """Largest motion."""
    start: float = 0.0
    """Travel where motion begins."""
    end: float = 1.0
    """Travel from which it is full."""
    bend: Bend | None = None
    """None: linear from ``start`` to ``end``."""
    parameter: str = ""
    """The vehicle's parameter that ``full`` comes from."""

    def motion(self, travel: float) -> float:
        """Motion that this travel asks for."""
        if travel <= self.start:
            return 0.0
        if travel >= self.end:
            return self.full
        share = (travel - self.start) / (self.end - self.start)
        # Rounding may carry a share beyond 1; also in the inverse.
        return self.full * min(share if self.bend is None else self.bend.bent(share), 1.0)

    def travel(self, motion: float) -> float:
        """Travel that asks for this motion: 0 for none, ``end`` for more than can be had."""
        if motion <= 0.0:
            return 0.0
        if motion >= self.full:
            return self.end
        share = motion / self.full
        if self.bend is not None:
            share = self.bend.straightened(share)
        return min(self.start + share * (self.end - self.start), self.end)

    def is_like(self, policy: "Half") -> bool:
        """So close to the policy's that its sticks need no mapping."""
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
        """Motion, with the stick's sign."""
        return self.above.motion(stick) if stick >= 0.0 else -self.below.motion(-stick)

    def stick(self, motion: float) -> float:
        """Inverse of ``motion``."""
        return self.above.travel(motion) if motion >= 0.0 else -self.below.travel(-motion)

    def is_like(self, policy: "Axis") -> bool:
        """Both halves are."""
        return self.above.is_like(policy.above) and self.below.is_like(policy.below)

    @classmethod
    def even(cls, half: Half) -> "Axis":
        """The same in both directions."""
        return cls(half, half)


class AxisMap(NamedTuple):
    """Throttle (m/s, + up) or yaw (degrees/s, + nose right)."""

    policy: Axis
    vehicle: Axis

    def to_vehicle(self, stick: float) -> float:
        """The vehicle's stick for the policy's."""
        return self.vehicle.stick(self.policy.motion(stick))

    def to_policy(self, stick: float) -> float:
        """The policy's stick for the vehicle's."""
        return self.policy.stick(self.vehicle.motion(stick))

    def saturates(self, stick: float) -> bool:
        """The policy's stick asks for more than the vehicle has."""
        motion = self.policy.motion(stick)
        half = self.vehicle.above if motion >= 0.0 else self.vehicle.below
        return abs(motion) > half.full * (1.0 + _ROUNDING)


class VehicleLean(NamedTuple):
    """Pitch and roll of the vehicle, whose lean is limited as a whole: both axes to one circle."""

    pitch: Axis
    """In degrees, or in the tangent of the lean; also in the next two."""
    roll: Axis
    full: float
    is_tangent: bool
    """The sticks ask for an acceleration, and so for the tangent of a lean."""
    parameter: str

    @property
    def full_deg(self) -> float:
        """Largest lean."""
        return math.degrees(math.atan(self.full)) if self.is_tangent else self.full

    def is_like(self, policy: Axis) -> bool:
        """So close to the policy's that its sticks need no mapping."""
        return not self.is_tangent and self.pitch.is_like(policy) and self.roll.is_like(policy)


class LeanMap(NamedTuple):
    """Pitch and roll."""

    policy: Axis
    """Lean in degrees, of either stick; both together no further than its full one."""
    vehicle: VehicleLean

    def to_vehicle(self, pitch: float, roll: float) -> tuple[float, float]:
        """The vehicle's pitch and roll sticks for the policy's."""
        vehicle = self.vehicle
        pitch, roll = _within(vehicle.full, *self._asked(pitch, roll))
        return vehicle.pitch.stick(pitch), vehicle.roll.stick(roll)

    def to_policy(self, pitch: float, roll: float) -> tuple[float, float]:
        """The policy's pitch and roll sticks for the vehicle's."""
        vehicle, policy = self.vehicle, self.policy
        pitch, roll = _within(vehicle.full, vehicle.pitch.motion(pitch), vehicle.roll.motion(roll))
        if vehicle.is_tangent:
            pitch, roll = math.degrees(math.atan(pitch)), math.degrees(math.atan(roll))
        pitch, roll = _within(policy.above.full, pitch, roll)
        return policy.stick(pitch), policy.stick(roll)

    def saturates(self, pitch: float, roll: float) -> bool:
        """The policy's sticks ask for more lean than the vehicle has."""
        return math.hypot(*self._asked(pitch, roll)) > self.vehicle.full * (1.0 + _ROUNDING)

    def _asked(self, pitch: float, roll: float) -> tuple[float, float]:
        """What the policy's sticks mean, in the vehicle's unit."""
        policy = self.policy
        pitch, roll = _within(policy.above.full, policy.motion(pitch), policy.motion(roll))
        if self.vehicle.is_tangent:
            return math.tan(math.radians(pitch)), math.tan(math.radians(roll))
        return pitch, roll


def _within(full: float, pitch: float, roll: float) -> tuple[float, float]:
    """The same direction, no longer than ``full``."""
    length = math.hypot(pitch, roll)
    if length <= full:
        return pitch, roll
    return pitch * full / length, roll * full / length


Quantity = Literal["climb", "descent", "yaw rate", "lean"]


@dataclass(frozen=True, slots=True, kw_only=True)
class StickCurves:
    """The map of one policy's sticks to one vehicle's, in one flight mode.

    A stick without a map (None) means the same to both, or has no meaning that a policy was trained
    for, and goes through unchanged to the last bit.
    """

    throttle: AxisMap | None = None
    yaw: AxisMap | None = None
    lean: LeanMap | None = None
    shortfalls: tuple[tuple[Quantity, str], ...] = ()
    """What this vehicle cannot do, each with a sentence."""
    unmapped: str | None = None
    """Why nothing is mapped although it should be."""

    @property
    def notes(self) -> tuple[str, ...]:
        """For the user, at the start."""
        return (*filter(None, [self.unmapped]), *(text for _, text in self.shortfalls))

    @property
    def is_identity(self) -> bool:
        """No stick is changed."""
        return self.throttle is None and self.yaw is None and self.lean is None

    def to_vehicle(self, sticks: Sticks) -> Sticks:
        """Sticks that make the vehicle do what the policy means by these; the centre within the
        policy's dead zone."""
        if self.is_identity:
            return sticks
        throttle, yaw, pitch, roll = sticks
        if self.lean is not None:
            pitch, roll = self.lean.to_vehicle(pitch, roll)
        return Sticks(
            throttle=throttle if self.throttle is None else self.throttle.to_vehicle(throttle),
            yaw=yaw if self.yaw is None else self.yaw.to_vehicle(yaw),
            pitch=pitch,
            roll=roll,
        )

    def to_policy(self, sticks: Sticks) -> Sticks:
        """Sticks by which the policy would mean what the vehicle does with these.

        The inverse of ``to_vehicle``, for sticks that were really sent and for the pilot's. Motion
        beyond what the policy's sticks can mean becomes its full stick.
        """
        if self.is_identity:
            return sticks
        throttle, yaw, pitch, roll = sticks
        if self.lean is not None:
            pitch, roll = self.lean.to_policy(pitch, roll)
        return Sticks(
            throttle=throttle if self.throttle is None else self.throttle.to_policy(throttle),
            yaw=yaw if self.yaw is None else self.yaw.to_policy(yaw),
            pitch=pitch,
            roll=roll,
        )

    def saturated(self, sticks: Sticks) -> tuple[str, ...]:
        """Names of the policy's sticks that mean more than the vehicle can do, in Sticks' order."""
        names: tuple[str, ...] = ()
        if self.throttle is not None and self.throttle.saturates(sticks.throttle):
            names += ("throttle",)
        if self.yaw is not None and self.yaw.saturates(sticks.yaw):
            names += ("yaw",)
        if self.lean is not None and self.lean.saturates(sticks.pitch, sticks.roll):
            motion = self.lean.policy.motion
            names += ("pitch",) if motion(sticks.pitch) else ()
            names += ("roll",) if motion(sticks.roll) else ()
        return names


IDENTITY = StickCurves()


class VehicleCurves(NamedTuple):
    """Motion that one vehicle makes of its sticks in one flight mode."""

    throttle: Axis | None
    """Climb rate in m/s, + up; None where the stick means something else."""
    yaw: Axis
    """Yaw rate in degrees/s, + nose right."""
    lean: VehicleLean


def curves_between(gains: StickGains, vehicle: VehicleCurves) -> StickCurves:
    """The map from a policy's sticks to a vehicle's, without the sticks that need none."""
    yaw = AxisMap(Axis.even(Half(gains.yaw_rate_degps, gains.yaw_dead_zone)), vehicle.yaw)
    lean = LeanMap(Axis.even(Half(gains.lean_deg, gains.lean_dead_zone)), vehicle.lean)
    throttle = None
    if vehicle.throttle is not None:
        dead_zone = gains.throttle_dead_zone
        climb, descent = Half(gains.climb_mps, dead_zone), Half(gains.descent_mps, dead_zone)
        throttle = AxisMap(Axis(climb, descent), vehicle.throttle)
    return StickCurves(
        throttle=None if throttle is None or _is_same(throttle) else throttle,
        yaw=None if _is_same(yaw) else yaw,
        lean=None if lean.vehicle.is_like(lean.policy) else lean,
        shortfalls=(*_axis_notes(throttle, yaw), *_lean_notes(lean)),
    )


def _is_same(axis: AxisMap) -> bool:
    return axis.vehicle.is_like(axis.policy)


def _axis_notes(throttle: AxisMap | None, yaw: AxisMap) -> Iterator[tuple[Quantity, str]]:
    if throttle is not None:
        up, down = throttle.vehicle
        yield from _note("climb", "climbs", "m/s", throttle.policy.above, up.full, up.parameter)
        yield from _note(
            "descent", "descends", "m/s", throttle.policy.below, down.full, down.parameter
        )
    right = yaw.vehicle.above
    yield from _note("yaw rate", "turns", "deg/s", yaw.policy.above, right.full, right.parameter)


def _lean_notes(lean: LeanMap) -> Iterator[tuple[Quantity, str]]:
    vehicle = lean.vehicle
    yield from _note("lean", "leans", "deg", lean.policy.above, vehicle.full_deg, vehicle.parameter)


def _note(
    noun: Quantity, verb: str, unit: str, policy: Half, most: float, parameter: str
) -> Iterator[tuple[Quantity, str]]:
    """A sentence if the vehicle cannot do all that the policy's stick means."""
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
    """No map, and the sentence that says why, if parameters are missing or cannot be; else None."""
    as_they_are = "the policy's sticks go to the vehicle as they are, whatever they mean to it"
    if missing := [name for name in needed if name not in values]:
        return StickCurves(unmapped=f"{as_they_are}: it did not send {', '.join(missing)}")
    if bad := [f"{name} is {values[name]:g}" for name in positive if not values[name] > 0.0]:
        return StickCurves(unmapped=f"{as_they_are}: {', '.join(bad)}")
    return None
