"""Settings of ``mavbridge fly``: the vehicle, the camera, the limits."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from mavbridge.config.checks import check_range
from mavbridge.config.groups import CAMERA, LIMITS, OUTPUT, RARE, VEHICLE
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.errors import UserError
from mavbridge.core.vehicle import Output


@Parameter(name="*", group=LIMITS)
@dataclass(frozen=True, kw_only=True)
class Limits:
    """Oldest inputs to act on, and the fastest stick movement."""

    max_attitude_age: float = 0.1
    """Oldest attitude and body rates to act on, in seconds."""
    max_velocity_age: float = 0.25
    """Oldest velocity and acceleration to act on, in seconds."""
    max_feature_age: float = 0.3
    """Oldest image feature to act on, in seconds since exposure."""
    tau: float = 0.05
    """Time constant of the stick low-pass, in seconds; 0 = off."""
    max_slew: float = 8.0
    """Fastest stick movement, in full deflections a second; 0 = no limit."""

    def __post_init__(self) -> None:
        """Refuse values that would switch a limit off by accident."""
        for name in ("max_attitude_age", "max_velocity_age", "max_feature_age"):
            check_range(name.replace("_", "-"), getattr(self, name), 0.01, 5, "s")
        check_range("tau", self.tau, 0, 2, "s")
        check_range("max-slew", self.max_slew, 0, 1000, "1/s")


@Parameter(name="*", group=VEHICLE)
@dataclass(frozen=True, kw_only=True)
class LinkConfig:
    """The vehicle and how to reach it."""

    connect: Annotated[str, Parameter(show_default=False)] = ""
    """The vehicle: udp:HOST:PORT (listen), udpout:HOST:PORT, tcp:HOST:PORT, /dev/ttyX,BAUD."""
    source_system: Annotated[int, Parameter(group=RARE)] = 255
    """Our MAVLink system id; ArduPilot obeys overrides from its MAV_GCS_SYSID (255) only."""
    target_system: Annotated[int, Parameter(group=RARE)] = 0
    """System id of the vehicle to fly; 0 = the only one on the link."""
    connect_timeout: Annotated[float, Parameter(group=RARE)] = 30.0
    """Seconds to wait for the vehicle's first heartbeat."""
    output: Output = "rc-override"
    """RC_CHANNELS_OVERRIDE (ArduPilot) or MANUAL_CONTROL (PX4)."""
    readonly: bool = False
    """Run everything, send no stick, mode or arm command."""

    def __post_init__(self) -> None:
        """Refuse ids that MAVLink has no room for."""
        check_range("source-system", self.source_system, 1, 255, "")
        check_range("target-system", self.target_system, 0, 254, "")
        check_range("connect-timeout", self.connect_timeout, 0.1, 3600, "s")


@Parameter(name="*", group=CAMERA)
@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """Where the images come from."""

    camera: str = "0"
    """Device index or /dev/videoN, rtsp:// udp:// http:// URL, video file, shm:NAME,
    screen:WINDOW TITLE."""
    window_name: Annotated[str | None, Parameter(group=RARE)] = None
    """Same as --camera "screen:WINDOW TITLE"."""

    @property
    def source(self) -> str:
        """The camera specification that both flags lead to."""
        return self.camera if self.window_name is None else f"screen:{self.window_name}"


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class FlyConfig:
    """One flight."""

    link: LinkConfig = field(default_factory=LinkConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    rates: Rates = field(default_factory=Rates)
    limits: Limits = field(default_factory=Limits)
    mode: Annotated[str | None, Parameter(group=VEHICLE)] = None
    """Flight mode to ask for before flying, e.g. ALT_HOLD; by default the mode is left alone."""
    arm: Annotated[bool, Parameter(group=VEHICLE)] = False
    """Arm the vehicle when everything is ready; by default arming is left to the pilot."""
    duration: Annotated[float | None, Parameter(group=VEHICLE)] = None
    """Seconds to fly, from the first action of the policy; by default until Ctrl-C."""
    rerun: Annotated[str, Parameter(group=OUTPUT)] = "off"
    """Rerun viewer: spawn, connect[=URL], FILE.rrd, or off."""
    record: Annotated[Path | None, Parameter(group=OUTPUT)] = None
    """Record the flight into this folder, new or empty: camera, ticks, raw MAVLink; needs the extra
    "record"."""
    report: Annotated[Path | None, Parameter(group=OUTPUT)] = None
    """Write the timing report here as JSON."""

    def __post_init__(self) -> None:
        """Refuse contradictions."""
        if self.duration is not None:
            check_range("duration", self.duration, 0.1, 86400, "s")
        if self.link.readonly and (self.arm or self.mode is not None):
            raise UserError("--readonly sends nothing, so it cannot be used with --arm or --mode")
