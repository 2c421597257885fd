"""Values that travel between the parts: frozen, with units and frames in their names.

Stamps are nanoseconds of the injected clock, taken where the thing happened (exposure, datagram
arrival). Arrays are read-only once they are published here.
"""

from dataclasses import asdict, dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.reasons import Reason, reason_to_json
from mavbridge.core.vehicle import Action, ActionTrace, FlightEnd, Sticks

FloatArray: TypeAlias = NDArray[np.float32]
ImageArray: TypeAlias = NDArray[np.uint8]
"""[H, W, 3] in RGB."""
CameraImage: TypeAlias = NDArray[np.uint8 | np.uint16]
"""[H, W, 3] uint8 in RGB; or [H, W] uint16, the depth of each pixel in units of the camera."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """One camera image."""

    frame_id: int
    captured_ns: int
    """Exposure, or failing that, arrival."""
    rgb: CameraImage
    """Read-only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureFrame:
    """An encoded image on its way from the vision loop to the action loop."""

    frame_id: int
    captured_ns: int
    ready_ns: int
    value: FloatArray
    """Dual rate: feature [1, F]. Single rate: preprocessed image [1, 3, H, W]. Read-only."""
    fault: Reason | None = None
    """Why it must not be acted on, such as a frozen image; None where nothing is wrong with it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleState:
    """The 13-D state of the contract, and when each of its parts was measured."""

    values: FloatArray
    """[13] float32: velocity m/s, attitude quaternion wxyz, body rates rad/s, specific force m/s^2,
    in the frame of the contract. Read-only."""
    attitude_ns: int
    rate_ns: int
    velocity_ns: int
    specific_force_ns: int
    extras: tuple[float, ...] = ()
    """The contract's ``state_extras``, as it orders them."""
    extras_ns: int | None = None
    """When the oldest of them was measured; None without any."""


class Position(NamedTuple):
    """A place in metres from an origin, in a frame that the name of the value tells."""

    north: float
    east: float
    down: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick:
    """One pass of the action loop, complete enough to explain it afterwards."""

    serial: int
    """Number among all ticks of the flight, without gaps: what an observer missed is one."""
    index: int
    due_ns: int
    woke_ns: int
    missed_slots: int
    """Of the stick grid, since the last tick, if the policy moved the sticks at both."""
    predict_ns: int | None
    """Duration of the policy's part; None when it did not run."""
    sent_ns: int
    """After the datagram was handed to the kernel."""
    feature_frame_id: int | None
    feature_captured_ns: int | None
    state: VehicleState | None
    trace: ActionTrace | None
    sent: Action | None
    """As sent, after rounding by the message; None when released or read-only."""
    release_reason: Reason | None
    """Why the policy does not fly; None while it does, and where the guard has not said why."""
    mode: str | None
    armed: bool
    rc_channels_us: tuple[int, ...]
    rc_sticks: Sticks | None
    texts: tuple[str, ...] = ()
    is_slot: bool = True
    """A slot of the stick grid; False: sent between two slots, at once for a new chunk."""
    chunk_serial: int | None = None
    """Number of the chunk that was flown; None when none was."""
    chunk_computed_ns: int | None = None
    """When the policy had finished that chunk."""
    is_coasting: bool = False
    """The chunk was too old to be flown as fresh, and was flown for the grace alone."""
    phase: str | None = None
    """State of the engagement: a value of ``guard.engagement.Phase``; None in old records."""
    position_ned_m: Position | None = None
    """From the estimator's origin; None where the vehicle tells none, or none that is fresh."""
    decided_ns: int | None = None
    """The moment that the sticks were decided for: the slot, or when a chunk was seen between two
    slots. None in old records."""

    @property
    def activity(self) -> str:
        """Who has the sticks, as a line for the user."""
        if self.release_reason is not None:
            return f"{self.holder}: {self.release_reason}"
        if self.trace is None:
            return "PREPARING: not in control yet"
        if self.sent is None:
            return "READ-ONLY: the policy runs, nothing is sent"
        return "FLYING: the policy has control"

    @property
    def stage(self) -> tuple[object, ...]:
        """Equal for ticks whose ``activity`` differs by figures alone."""
        reason = None if self.release_reason is None else self.release_reason.key
        return self.holder, reason, self.trace is None, self.sent is None

    @property
    def holder(self) -> str:
        """WAITING for an act, PREPARING after one, NEUTRAL sticks of ours, or RELEASED.

        Only where the policy does not fly.
        """
        if self.phase in ("waiting", "preparing"):
            return self.phase.upper()
        return "NEUTRAL" if self.phase in ("leaving", "holding") else "RELEASED"


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightOutcome:
    """How the policy flew, from its first action to its last one; None = not known."""

    end: FlightEnd
    reason: Reason | None
    """The end, as the guard told it; None: not told."""
    flown_s: float
    height_m: float | None
    """Above the estimator's origin, at the policy's last action."""
    speed_mps: float | None
    """At the policy's last action."""
    mode: str | None
    """Mode, arming and landing are the vehicle's last word in this run."""
    is_armed: bool
    is_landed: bool | None
    gates_total: int | None
    """None: no course was named."""
    gates_passed: int | None
    """In order, forward, inside the opening; None also where the vehicle tells no position."""
    course_s: float | None
    """From the first action to the last gate that was passed."""
    course_speed_mps: float | None
    """Along the straight legs from the first gate to the last one passed; None before two."""
    crash: str | None
    """How it was seen to have hit something, in words; None: no contact was seen or told."""

    def to_json(self) -> dict[str, object]:
        """The outcome for JSON: the reason with its code, kind, figures and sentence."""
        reason = None if self.reason is None else reason_to_json(self.reason)
        return asdict(replace(self, reason=None)) | {"reason": reason}

    @property
    def success(self) -> bool | None:
        """False for a flight that failed, True for a whole course; else nobody can say."""
        if self.crash is not None or self.end == "fault":
            return False
        return None if self.gates_passed is None else self.gates_passed == self.gates_total


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
    rgb: CameraImage
    """What the policy saw, before resizing; read-only."""
    camera: int = 0
    """Its place among the cameras of the contract; ``serial`` and all others are of this camera."""
    feature: FloatArray | None = None
    """What the encoder made of it, read-only: dual rate [1, F], single rate the network's image."""
    fault: Reason | None = None
    """Why it must not be acted on, such as a frozen image."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Solve:
    """One call of the policy: what it was given, when, and what it returned; it can be repeated."""

    serial: int
    """That of its chunk, which rises by one."""
    started_ns: int
    computed_ns: int
    reset_ns: int
    """When the policy was last reset before it, for a flight; 0: when it was loaded."""
    state: VehicleState
    """The newest."""
    states: FloatArray
    """[1, *contract.state_shape], as the policy got them. Read-only."""
    history: FloatArray
    """Sticks sent before, [1, history_len, 4]. Read-only."""
    frame_ids: tuple[tuple[int, ...], ...]
    """Images whose features it was given, [T][cameras], oldest first, in the contract's order."""
    image_ns: int
    """Exposure of the oldest among the newest images of all cameras."""
    first_ns: int
    """When the first action acts."""
    step_ns: int
    """Time from one action to the next."""
    actions: FloatArray
    """[1, horizon, 4] as the policy returned them, in its own frame, not clipped. Read-only."""


Event: TypeAlias = Tick | VisionTick
"""What the loops report to every observer."""
Observed: TypeAlias = Event | Solve
"""What the recorder and the viewer take as well."""


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
