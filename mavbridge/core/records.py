"""Values that travel between components: frozen, with units and frames in their names; and the
protocols of the cameras that make them and the sinks that take them.

Stamps are nanoseconds of the injected clock, taken at the source (exposure, datagram arrival).
Arrays are read-only once they are published here.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.reasons import Reason
from mavbridge.core.ticks import GuardTick
from mavbridge.core.vehicle import FlightEnd, Sticks

FloatArray: TypeAlias = NDArray[np.float32]
ImageArray: TypeAlias = NDArray[np.uint8]
"""[H, W, 3] in RGB."""
CameraImage: TypeAlias = NDArray[np.uint8 | np.uint16]
"""[H, W, 3] uint8 in RGB; or [H, W] uint16, the depth of each pixel in units of the camera."""
RateMode = Literal["dual", "single"]
"""Whether images are encoded at a rate of their own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """One camera image."""

    frame_id: int
    captured_ns: int
    """Exposure if the source tells it, else arrival."""
    rgb: CameraImage
    """Read-only."""
    is_stamped: bool = False
    """True if the source tells the exposure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureFrame:
    """Encoded image, passed from the vision loop to the policy loop."""

    frame_id: int
    captured_ns: int
    ready_ns: int
    value: FloatArray
    """Dual rate: feature [1, F]. Single rate: preprocessed image [1, 3, H, W]. Read-only."""
    fault: Reason | None = None
    """Why the image must not be acted on, such as a frozen image, or None."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleState:
    """The contract's 13-D state, with the time at which each part was measured."""

    values: FloatArray
    """[13] float32: velocity m/s, attitude quaternion wxyz, body rates rad/s, specific force m/s^2,
    in the frame of the contract. Read-only."""
    attitude_ns: int
    rate_ns: int
    velocity_ns: int
    specific_force_ns: int
    extras: tuple[float, ...] = ()
    """Optional inputs (``state_extras``), in the contract's order."""
    extras_ns: int | None = None
    """When the oldest optional input was measured; None without any."""

    @property
    def speed_mps(self) -> float:
        """Length of the velocity."""
        return math.hypot(*self.values[:3].tolist())


class Position(NamedTuple):
    """Position in metres from an origin; the field's name tells the frame."""

    north: float
    east: float
    down: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick(GuardTick):
    """One step of the guard, with everything that explains it afterwards.

    ``missed_slots`` is 0 unless the policy had control at this tick and the one before.
    """

    predict_ns: int | None
    """Duration of the policy's solve; None if no chunk was flown."""
    feature_frame_id: int | None
    feature_captured_ns: int | None
    state: VehicleState | None
    mode: str | None
    armed: bool
    rc_channels_us: tuple[int, ...]
    rc_sticks: Sticks | None
    texts: tuple[str, ...] = ()
    chunk_computed_ns: int | None = None
    """End of the solve that made the chunk."""
    position_ned_m: Position | None = None
    """Position from the estimator's origin; None if the vehicle reports none or a stale one."""
    readonly: bool = False
    """True if the flight sends no action; in a recording, if no tick has one."""

    @property
    def is_refused(self) -> bool:
        """True if the link did not take the policy's action."""
        return self.trace is not None and self.sent is None and not self.readonly

    @property
    def lacks_neutral(self) -> bool:
        """True if nothing was sent while LEAVING or HOLDING; with ``FlightMeta.keeps_neutral``
        the link refused it."""
        return self.sent is None and self.phase in ("leaving", "holding")

    @property
    def activity(self) -> str:
        """One line that tells the user who has control."""
        if self.release_reason is not None:
            return f"{self.holder}: {self.release_reason}"
        if self.trace is None:
            return "PREPARING: not in control yet"
        if self.readonly:
            return "READ-ONLY: the policy runs, nothing is sent"
        return "FLYING: the policy has control"

    @property
    def stage(self) -> tuple[object, ...]:
        """Key that is equal for ticks whose ``activity`` differs by figures alone."""
        reason = None if self.release_reason is None else self.release_reason.key
        return self.holder, reason, self.trace is None, self.readonly

    @property
    def holder(self) -> str:
        """The phase, for ticks in which the policy does not fly; RELEASED from RELEASING on."""
        if self.phase in ("waiting", "preparing", "leaving", "holding"):
            return self.phase.upper()
        return "RELEASED"


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightOutcome:
    """Summary of a flight from the policy's first action to its last. None: not known."""

    end: FlightEnd
    reason: Reason | None
    """Reason of the end, as the guard reported it; None: not reported."""
    flown_s: float
    height_m: float | None
    """Height above the estimator's origin at the policy's last action."""
    speed_mps: float | None
    """Speed at the policy's last action."""
    mode: str | None
    """Mode, arming and landing: last report of the vehicle in this run."""
    is_armed: bool
    is_landed: bool | None
    is_current: bool = True
    """False: the guard was gone, so that the vehicle's last report may be out of date."""
    gates_total: int | None
    """None: no course was named."""
    gates_passed: int | None
    """Gates passed in order, forward and inside the opening; None also if the vehicle reports no
    position."""
    course_s: float | None
    """Time from the first action to the last gate passed."""
    course_speed_mps: float | None
    """Mean speed along the straight legs from the first to the last gate passed; None before
    two."""
    crash: str | None
    """How the vehicle hit something, in words; None: no contact was seen or reported."""

    @property
    def success(self) -> bool | None:
        """False for a flight that failed, True for a whole course, None if unknown."""
        if self.crash is not None or self.end == "fault":
            return False
        return None if self.gates_passed is None else self.gates_passed == self.gates_total


@dataclass(frozen=True, slots=True, kw_only=True)
class VisionTick:
    """One frame's way through the vision loop."""

    serial: int
    """Number among all frames of this camera, without gaps."""
    frame_id: int
    captured_ns: int
    started_ns: int
    ready_ns: int
    dropped_frames: int
    """Frames dropped by the source since it was opened."""
    rgb: CameraImage
    """Image before resizing; read-only."""
    camera: int = 0
    """Index of the camera in the contract. All other fields belong to this camera."""
    feature: FloatArray | None = None
    """Encoded image, read-only: feature [1, F] (dual rate) or the network's image (single rate).
    None: the policy refused the image, or features are not kept."""
    fault: Reason | None = None
    """Why the image must not be acted on, such as a frozen image."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Solve:
    """One call of the policy, with its inputs and its result, so that it can be repeated."""

    serial: int
    """Number of its chunk; rises by one."""
    started_ns: int
    computed_ns: int
    reset_ns: int
    """Last reset of the policy for a flight; 0: it was reset when it was loaded."""
    state: VehicleState
    """Newest state."""
    states: FloatArray
    """States as passed to the policy, [1, *contract.state_shape]. Read-only."""
    history: FloatArray
    """Actions sent before, [1, history_len, 4]. Read-only."""
    frame_ids: tuple[tuple[int, ...], ...]
    """Frame ids of the features, [T][cameras], oldest first, in the contract's order."""
    image_ns: int
    """Oldest exposure among the newest images of all cameras."""
    first_ns: int
    """Time at which the first action acts."""
    step_ns: int
    """Time between two actions."""
    actions: FloatArray
    """Actions [1, horizon, 4] as the policy returned them, in its own frame, not clipped.
    Read-only."""


Event: TypeAlias = Tick | VisionTick
"""Events that the loops report to every observer."""
Observed: TypeAlias = Event | Solve
"""Events that the recorder and the viewer take in addition."""


class Camera(Protocol):
    """Video source, opened by its constructor and used by one thread."""

    @property
    def dropped_frames(self) -> int:
        """Number of frames that were delivered and not read, since the source was opened."""

    def read(self, timeout_ns: int) -> Frame | None:
        """Return the newest frame not returned before; None if none arrives within the timeout.

        Raises:
            CameraError: the source has died and will not recover by itself.
        """

    def close(self) -> None:
        """Free the source and join its thread. May be called twice."""


class TickSink(Protocol):
    """Receiver of events. Must never block and never raise."""

    def emit(self, event: Event) -> None:
        """Take the event, or drop and count it."""
