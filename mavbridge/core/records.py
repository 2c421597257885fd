"""Values that travel between the parts: frozen, with units and frames in their names.

Stamps are nanoseconds of the injected clock, taken where the thing happened (exposure, datagram
arrival). Arrays are read-only once they are published here.
"""

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float32]
ImageArray: TypeAlias = NDArray[np.uint8]


class Sticks(NamedTuple):
    """Stick positions in [-1, 1], in the order of the action vector.

    +throttle = up (0 is mid-stick), +yaw = nose right, +pitch = stick forward = nose down,
    +roll = right.
    """

    throttle: float
    yaw: float
    pitch: float
    roll: float


NEUTRAL = Sticks(throttle=0.0, yaw=0.0, pitch=0.0, roll=0.0)
IDLE = Sticks(throttle=-1.0, yaw=0.0, pitch=0.0, roll=0.0)
"""Throttle at the bottom, the rest centred: what arming demands."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Hold the vehicle's sticks here."""

    sticks: Sticks


@dataclass(frozen=True, slots=True)
class Release:
    """Do not touch the sticks: they belong to the pilot. ``reason`` is shown to the user."""

    reason: str


Decision: TypeAlias = Command | Release


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """One camera image."""

    frame_id: int
    captured_ns: int
    """Exposure, or failing that, arrival."""
    rgb: ImageArray
    """[H, W, 3] uint8, RGB, read-only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureFrame:
    """An encoded image on its way from the vision loop to the action loop."""

    frame_id: int
    captured_ns: int
    ready_ns: int
    value: FloatArray
    """Dual rate: feature [1, F]. Single rate: preprocessed image [1, 3, H, W]. Read-only."""


class Reading(NamedTuple):
    """One measurement of the vehicle as it came in."""

    arrived_ns: int
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Telemetry:
    """Newest reading of each quantity, in MAVLink's frames (NED world, FRD body); None = never."""

    ned_from_body_wxyz: Reading | None = None
    rate_body_radps: Reading | None = None
    velocity_ned_mps: Reading | None = None
    specific_force_body_mps2: Reading | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleStatus:
    """The vehicle's state as its heartbeat and RC_CHANNELS report it."""

    mode: str
    armed: bool
    rc_sticks: Sticks | None = None
    """Sticks that the vehicle acts on (RC_CHANNELS through its calibration)."""
    rc_channels_us: tuple[int, ...] = ()
    rc_arrived_ns: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSnapshot:
    """Everything that the link knows at one tick."""

    telemetry: Telemetry
    status: VehicleStatus | None
    problem: str | None
    """Why sticks may not be sent (no heartbeat, handshake, override switch, no echo), or None."""
    is_overruled: bool = False
    """The vehicle does not act on the sticks that we send: somebody else holds them."""
    echo_confirmed: bool = False
    """The vehicle was seen to act on our sticks, or its output has no echo to check."""
    texts: tuple[str, ...] = ()
    """Status texts of the vehicle and warnings of the link since the last snapshot."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleState:
    """The 13-D state of the contract and the arrival of each of its parts."""

    values: FloatArray
    """[13] float32: velocity m/s, attitude quaternion wxyz, body rates rad/s, specific force m/s^2,
    in the frame of the contract. Read-only."""
    attitude_ns: int
    rate_ns: int
    velocity_ns: int
    specific_force_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class StickTrace:
    """One action on its way from the policy to the wire."""

    raw: Sticks
    clipped: Sticks
    slewed: Sticks
    smoothed: Sticks


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick:
    """One pass of the action loop, complete enough to explain it afterwards."""

    serial: int
    """Number among all ticks of the flight, without gaps: what an observer missed is one."""
    index: int
    due_ns: int
    woke_ns: int
    missed_slots: int
    predict_ns: int | None
    """Duration of the policy's part; None when it did not run."""
    sent_ns: int
    """After the datagram was handed to the kernel."""
    feature_frame_id: int | None
    feature_captured_ns: int | None
    state: VehicleState | None
    trace: StickTrace | None
    sent: Sticks | None
    """Sticks as sent, after rounding to PWM; None when released or read-only."""
    release_reason: str | None
    mode: str | None
    armed: bool
    rc_channels_us: tuple[int, ...]
    rc_sticks: Sticks | None
    texts: tuple[str, ...] = ()

    @property
    def activity(self) -> str:
        """Who has the sticks, as a line for the user."""
        if self.release_reason is not None:
            return f"RELEASED: {self.release_reason}"
        if self.trace is None:
            return "PREPARING: sticks idle"
        if self.sent is None:
            return "READ-ONLY: the policy runs, nothing is sent"
        return "FLYING: the policy has the sticks"


@dataclass(frozen=True, slots=True, kw_only=True)
class VisionTick:
    """One frame through the vision loop."""

    serial: int
    """Number among all frames through the loop, without gaps."""
    frame_id: int
    captured_ns: int
    started_ns: int
    ready_ns: int
    dropped_frames: int
    """Frames dropped by the source since it was opened."""
    rgb: ImageArray
    """[H, W, 3] uint8, read-only: what the policy saw, before resizing."""


Event: TypeAlias = Tick | VisionTick


class Packet(NamedTuple):
    """One MAVLink packet as it came or left."""

    stamp_ns: int
    """Arrival, or handed to the kernel."""
    data: bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class Percentiles:
    """Distribution of a measured quantity; the unit is in the name of what holds it."""

    p50: float
    p99: float
    p999: float
    max: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStats:
    """Counters of the link over one flight; None = not measured."""

    messages_per_s: tuple[tuple[str, float], ...]
    """Mean arrival rate by MAVLink message name."""
    lost_fraction: float | None
    rtt_ms: Percentiles | None
    """Round trips of our own TIMESYNC requests."""
    sent_overrides: int
    """Stick messages handed to the kernel; releases not counted."""
    echo_confirmed: bool | None
    """The vehicle showed our sticks in RC_CHANNELS; None = no stick was sent."""
    unusable_packets: int = 0
    """Corrupt, cut off, or holding NaN."""
    vehicle_clock_offset_ns: int | None = None
    """Vehicle's clock minus ours, by TIMESYNC: joins our stamps with the vehicle's log."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutFrame:
    """One row of an imagined flight: everything about a frame except its pixels."""

    number: int
    """Frame number in the video."""
    iteration: int
    frame: int
    """Frame number within its iteration."""
    executed: bool
    """The next decision was made after it; the others were only looked at."""
    step: int
    """Steps since the newest frame that was really seen; iterations may overlap."""
    frame_dt_s: float
    state: FloatArray
    """[13]"""
    action: FloatArray
    """[4], the mean stick of the step before it."""

    @property
    def time_s(self) -> float:
        """Time since the newest frame that was really seen."""
        return self.step * self.frame_dt_s
