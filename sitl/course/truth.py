"""Where the gates are as seen from the vehicle: what a learner may be told besides the sticks."""

from dataclasses import dataclass

from sitl.course.course import Course
from sitl.rotation import Quat, Vec3, conjugate, rotate, to_euler, wrap_pi


@dataclass(frozen=True, slots=True, kw_only=True)
class GateTruth:
    """The gates ahead at one pose; None for what there is no longer."""

    next_gate: int | None
    """Index."""
    gate_body_m: Vec3 | None
    """Centre of the next gate in FRD body axes."""
    gate_yaw_rad: float | None
    """Heading of its passage relative to the body's heading, in [-pi, pi]."""
    gate_after_body_m: Vec3 | None
    """Centre of the gate after it."""


def gate_truth(
    course: Course, next_gate: int | None, position_ned_m: Vec3, ned_from_body_wxyz: Quat
) -> GateTruth:
    """The truth about the gates from ``next_gate`` on."""
    if next_gate is None:
        return GateTruth(
            next_gate=None, gate_body_m=None, gate_yaw_rad=None, gate_after_body_m=None
        )
    body_from_ned = conjugate(ned_from_body_wxyz)
    ahead = [
        _seen(gate.center_ned_m, position_ned_m, body_from_ned)
        for gate in course.gates[next_gate : next_gate + 2]
    ]
    _, _, yaw_rad = to_euler(ned_from_body_wxyz)
    return GateTruth(
        next_gate=next_gate,
        gate_body_m=ahead[0],
        gate_yaw_rad=wrap_pi(course.gates[next_gate].yaw_rad - yaw_rad),
        gate_after_body_m=ahead[1] if len(ahead) > 1 else None,
    )


def _seen(point_ned_m: Vec3, eye_ned_m: Vec3, body_from_ned: Quat) -> Vec3:
    north_m, east_m, down_m = (p - e for p, e in zip(point_ned_m, eye_ned_m, strict=True))
    return rotate(body_from_ned, (north_m, east_m, down_m))
