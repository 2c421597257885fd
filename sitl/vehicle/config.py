"""Configuration of a simulated vehicle of either firmware."""

from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

from sitl.vehicle.conditions import NOMINAL, Conditions

STEP_NS = 2_500_000  # grid of receiving, advancing and sending

IDLE_RECEIVER_US = (1500, 1500, 1000, 1500, 1500, 1500, 1500, 1500)
"""Untouched transmitter: throttle down, the rest centred."""
MID_RECEIVER_US = (1500,) * 8
"""Every stick centred, throttle included: the sticks of a pilot on standby."""

AutopilotName: TypeAlias = Literal["ardupilot", "px4"]

ArduPilotRelease: TypeAlias = Literal["4.6", "4.7-dev"]
"""ArduPilot release for the names of parameters; 4.5 has those of 4.6. The measured firmware,
4.7-dev, has the new names of the system ids and the old names of the rest."""

Px4Release: TypeAlias = Literal["1.17", "1.18"]
"""PX4 release for parameters and stick override; 1.18 was measured."""

SIGNING_TICK_NS = 10_000


class SigningKey(NamedTuple):
    """MAVLink 2 signing of every link."""

    key: bytes  # 32 bytes
    timestamp: int  # time since 2015 at zero of the vehicle's clock, in SIGNING_TICK_NS


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleConfig:
    """Configuration of one simulated vehicle."""

    autopilot: AutopilotName = "ardupilot"
    ardupilot_release: ArduPilotRelease = "4.7-dev"
    px4_release: Px4Release = "1.18"
    receiver_us: tuple[int, ...] | None = IDLE_RECEIVER_US
    """Channels of the RC receiver at boot [us]; None: no receiver. Without one, ArduCopter's sticks
    latch and its radio fails; PX4 uses it only if COM_RC_IN_MODE says so."""
    estimator_ready_s: float = 3.0
    """Time from boot until arming is possible (about 23 s on the real firmware)."""
    position_ready_s: float = 5.0
    """Time from boot until the estimator has a position (about 40 s on the real firmware)."""
    signing: SigningKey | None = None
    """Sign all messages, and refuse those not signed with this key."""
    conditions: Conditions = NOMINAL
    """Airframe, air and sensors; `sitl.camera.fpv.FpvRenderer` uses those of the camera."""


DEFAULT_VEHICLE = VehicleConfig()
