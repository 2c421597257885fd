"""What a row of each table holds, as records; the Arrow side is ``schema``."""

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from mavbridge.core.records import Sticks, Tick

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTruth:
    """The simulator's truth at one exposure: labels for auxiliary losses."""

    position_ned_m: Vector
    ned_from_body_wxyz: Quaternion
    velocity_ned_mps: Vector
    next_gate: int | None
    """Index in the course; None after the last."""
    gate_body_m: Vector | None
    """Centre of the next gate in FRD body axes."""
    gate_yaw_rad: float | None
    """Heading of the passage relative to the body's."""
    gate_after_body_m: Vector | None
    """Centre of the gate after that."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameRow:
    """What is known of a frame besides its pixels."""

    frame_id: int
    captured_ns: int
    ready_ns: int
    dropped_before: int = 0
    """Frames lost on the way to the recording, just before this one."""
    truth: FrameTruth | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TickLabels:
    """What a demonstration knows of a tick beyond the flight."""

    expert: Sticks | None
    """Sticks that the expert would hold here, free of the disturbance that was flown."""


class TickRow(NamedTuple):
    """One row of the ticks table."""

    tick: Tick
    dropped_before: int
    """Ticks lost on the way to the recording, just before this one."""
    labels: TickLabels | None = None
