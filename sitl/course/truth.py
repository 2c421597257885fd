"""Ground truth about the gates as seen from the vehicle: labels beside the expert's sticks."""

from dataclasses import dataclass

from sitl.course.layout import Course
from sitl.rotation import Quat, Vec3, conjugate, rotate, to_euler, wrap_pi


@dataclass(frozen=True, slots=True, kw_only=True)
class GateTruth:
    """The next two gates relative to one pose; None where the course has no more gates."""

    next_gate: int | None = None  # index of the next gate
    gate_body_m: Vec3 | None = None  # centre of the next gate in FRD body axes
    gate_yaw_rad: float | None = None  # heading of its passage minus the body's, in [-pi, pi]
    gate_after_body_m: Vec3 | None = None  # centre of the gate after it, in FRD body axes


def gate_truth(
    course: Course, next_gate: int | None, position_ned_m: Vec3, ned_from_body_wxyz: Quat
) -> GateTruth:
    """Ground truth at a pose for ``next_gate`` and the gate after it."""
    if next_gate is None:
        return GateTruth()
    body_from_ned = conjugate(ned_from_body_wxyz)
    centers_body_m = []
    for gate in course.gates[next_gate : next_gate + 2]:
        north_m, east_m, down_m = (
            center - own for center, own in zip(gate.center_ned_m, position_ned_m, strict=True)
        )
        centers_body_m.append(rotate(body_from_ned, (north_m, east_m, down_m)))
    _, _, yaw_rad = to_euler(ned_from_body_wxyz)
    return GateTruth(
        next_gate=next_gate,
        gate_body_m=centers_body_m[0],
        gate_yaw_rad=wrap_pi(course.gates[next_gate].yaw_rad - yaw_rad),
        gate_after_body_m=centers_body_m[1] if len(centers_body_m) > 1 else None,
    )
