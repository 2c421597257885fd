"""Settings of ``mavbridge fly``: vehicle, camera, limits."""

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from mavbridge.config.flags import (
    CAMERA,
    ENGAGING,
    OUTPUT,
    VEHICLE,
    Ranged,
    hidden,
    section,
)
from mavbridge.config.policy import PolicyConfig, Rates
from mavbridge.core.errors import UserError
from mavbridge.core.vehicle import OnFault, Risk
from policy.fields import Between

OutputChoice = Literal["auto", "rc-override", "manual-control", "attitude", "rates", "velocity"]
"""``core.vehicle.Output``, or the usual one."""
MAX_GOAL_M = 100_000.0
_FLOAT32_MAX = 3.4e38
"""Largest value of a MAVLink parameter."""
Age = Annotated[float | None, Between(0.01, 60, "s")]


@section("limits")
@dataclass(frozen=True, kw_only=True)
class Limits(Ranged):
    """Maximum input ages and stick speed."""

    max_attitude_age: Age = None
    """Oldest attitude and body rates to act on, in seconds, when a command leaves; default: the
    policy's contract, which this can only tighten."""
    max_velocity_age: Age = None
    """Oldest velocity and acceleration to act on, in seconds; default: the policy's contract,
    which this can only tighten."""
    max_feature_age: Age = None
    """Oldest image to act on, in seconds since exposure; default: the policy's
    contract, which this can only tighten."""
    max_chunk_age: Age = None
    """Oldest chunk of actions to act on, in seconds since it was computed; default: the
    policy's contract, which this can only tighten."""
    max_stall: Age = None
    """Longest time in seconds to fly on along one chunk when no newer one comes; default:
    the policy's contract, which this can only tighten."""
    max_frozen_state: Annotated[float, Between(0, 60, "s")] = 0.5
    """Longest time in seconds for which the attitude may stay bit-identical while the vehicle
    turns; 0 = no limit."""
    tau: Annotated[float | None, Between(0, 2, "s")] = None
    """Time constant in seconds of the low-pass filter on actions; 0 = off; default: 0.05, for body
    rates 0.01."""
    max_slew: Annotated[float, Between(0, 1000, "1/s")] = 8.0
    """Fastest stick movement, in full deflections a second; 0 = no limit."""


@section("envelope")
@dataclass(frozen=True, kw_only=True)
class EnvelopeConfig(Ranged):
    """Flight envelope; default: the wider of ours and the policy's."""

    max_tilt: Annotated[float | None, Between(0, 180, "deg")] = None
    """Largest tilt, in degrees; by default 60 or what the policy needs; 0 = not watched."""
    max_height: Annotated[float | None, Between(0, 100_000, "m")] = None
    """Largest height above the estimator's origin, in metres; by default 120; 0 = not watched."""
    max_speed: Annotated[float | None, Between(0, 1000, "m/s")] = None
    """Fastest speed, in m/s; by default 20; 0 = not watched."""
    max_distance: Annotated[float | None, Between(0, 100_000, "m")] = None
    """Farthest from the estimator's origin, in metres; by default 300; 0 = not watched."""
    min_battery: Annotated[float, Between(0, 100, "%")] = 10.0
    """Lowest charge, in percent; 0 = only what the vehicle itself calls low."""


@section("setpoints")
@dataclass(frozen=True, kw_only=True)
class SetpointLimits(Ranged):
    """Limits of setpoints; the autopilot itself limits few of them."""

    setpoint_lean: Annotated[float, Between(0.01, 80, "deg")] = 35.0
    """Largest lean of an attitude, in degrees."""
    setpoint_rate: Annotated[float, Between(0.01, 2000, "deg/s")] = 220.0
    """Fastest roll and pitch rate, in degrees a second."""
    setpoint_yaw_rate: Annotated[float, Between(0.01, 1000, "deg/s")] = 120.0
    """Fastest yaw rate, in degrees a second."""
    setpoint_thrust: Annotated[float, Between(0.01, 1, "of full thrust")] = 0.9
    """Largest collective thrust, by the policy's scale."""
    setpoint_speed: Annotated[float, Between(0.01, 100, "m/s")] = 8.0
    """Fastest horizontal velocity, in m/s."""
    setpoint_climb: Annotated[float, Between(0.01, 50, "m/s")] = 3.0
    """Fastest climb and descent, in m/s."""
    setpoint_accel: Annotated[float, Between(0.01, 100, "m/s^2")] = 5.0
    """Fastest change of a velocity, in m/s^2."""


@Parameter(name="*", group=VEHICLE)
@dataclass(frozen=True, kw_only=True)
class ListenConfig(Ranged):
    """A vehicle to listen to."""

    connect: Annotated[str, Parameter(show_default=False)] = ""
    """Vehicle: udp:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or /dev/ttyX,BAUD."""
    signing_key_file: Annotated[Path | None, Parameter(show_default=False)] = None
    """File with the vehicle's MAVLink 2 key: sign, and accept signed packets only."""
    target_system: Annotated[int, hidden("link.target-system"), Between(0, 254)] = 0
    """System id of the vehicle to fly; 0 = the only one on the link."""
    connect_timeout: Annotated[float, hidden("link.timeout"), Between(0.1, 3600, "s")] = 30.0
    """Seconds to wait for the vehicle's first heartbeat."""


@Parameter(name="*", group=VEHICLE)
@dataclass(frozen=True, kw_only=True)
class LinkConfig(ListenConfig):
    """The vehicle and how to reach it."""

    source_system: Annotated[int, hidden("link.source-system"), Between(1, 255)] = 255
    """Our MAVLink system id. ArduPilot obeys overrides of its MAV_GCS_SYSID (255) only."""
    output: Annotated[OutputChoice, Parameter(show_choices=False)] = "auto"
    """auto, rc-override, manual-control, attitude, rates or velocity."""
    raw_sticks: Annotated[bool, hidden("link.raw-sticks")] = False
    """Send the policy's sticks unchanged; default: map them to this vehicle's stick curves."""
    readonly: bool = False
    """Run everything, but send no stick, mode or arm command."""
    set: Annotated[tuple[str, ...], Parameter(negative="", show_default=False)] = ()
    """NAME=VALUE: set a parameter of the vehicle for the flight; repeatable."""
    accept_risk: Annotated[tuple[Risk, ...], hidden("link.accept-risk")] = ()
    """Fly in spite of a setting for which a flight is refused."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.set_params and self.readonly:
            raise UserError("--readonly sets no parameter: leave out --set")

    @property
    def set_params(self) -> tuple[tuple[str, float], ...]:
        """Names and values of ``--set``; raises UserError for a malformed or repeated one."""
        read: dict[str, float] = {}
        for text in self.set:
            match = re.fullmatch(r"([A-Za-z0-9_]{1,16})=(.+)", text)
            try:
                name, value = (match[1].upper(), float(match[2])) if match else ("", math.nan)
            except ValueError:
                value = math.nan
            if not abs(value) < _FLOAT32_MAX:  # also true of NaN
                raise UserError(
                    f"--set {text} is not understood: use NAME=VALUE with a number, such as "
                    "RC_OVERRIDE_TIME=0.5"
                )
            if name in read:
                raise UserError(f"--set names {name} twice: leave one out")
            if name.startswith("RCMAP_"):
                raise UserError(
                    f"--set {text}: it counts from the vehicle's next boot on; set it with your "
                    "ground station, and reboot the vehicle"
                )
            read[name] = value
        return tuple(read.items())


def split_camera(text: str) -> tuple[str, str]:
    """Split a value of ``--camera`` into name and source; the name is empty if not given."""
    name, equals, source = text.partition("=")
    return (name, source) if equals and name.isidentifier() else ("", text)


@Parameter(name="*", group=CAMERA)
@dataclass(frozen=True, kw_only=True)
class CameraConfig(Ranged):
    """Camera of the policy."""

    camera: Annotated[tuple[str, ...], Parameter(negative="", show_default=" ".join)] = ("0",)
    """0, /dev/videoN, URL, FILE, shm:NAME, screen:TITLE, pipe:..., none."""
    camera_timeout: Annotated[float, hidden("link.camera-timeout"), Between(0.1, 3600, "s")] = 10.0
    """Seconds to wait for the camera's first frame."""
    camera_latency: Annotated[float, Between(0, 2000, "ms")] = 0.0
    """Milliseconds from exposure to arrival; a frame may be stamped older, not younger."""
    max_frozen_image: Annotated[float, hidden("limits.frozen-image"), Between(0, 60, "s")] = 0.5
    """Longest time in seconds for which the image may stay identical in flight; 0 = no limit."""
    max_black_image: Annotated[float, hidden("limits.black-image"), Between(0, 60, "s")] = 0.5
    """Longest time in seconds for which the image may be black or of one colour; 0 = no limit."""

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [name for name, _ in self._named]
        if not names:
            raise UserError("camera is an empty list: name a camera, or none")
        if len(set(names)) < len(names) or (len(names) > 1 and "" in names):
            raise UserError(
                f"--camera {' '.join(self.camera)}: with several cameras each has a name of its "
                "own, as in --camera front=0 --camera down=/dev/video2"
            )

    @property
    def _named(self) -> tuple[tuple[str, str], ...]:
        """Name and source of each camera; the name is empty if not given."""
        return tuple(map(split_camera, self.camera))

    @property
    def sources(self) -> tuple[str, ...]:
        """Sources of the cameras, in the order of the flags."""
        return tuple(source for _, source in self._named)

    def sources_of(self, cameras: tuple[str, ...]) -> tuple[str, ...]:
        """Return the source of each camera of a contract; raise UserError if the names do not
        match."""
        found = dict(self._named)
        if len(cameras) == 1 and "" in found:
            return (found[""],)
        if set(found) == set(cameras):
            return tuple(found[name] for name in cameras)
        wanted = " ".join(f"--camera {name}=SOURCE" for name in cameras)
        raise UserError(
            f"--camera {' '.join(self.camera)}: this policy looks through the "
            f"camera{'s' if len(cameras) > 1 else ''} {', '.join(cameras)}: give {wanted}"
        )


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class FlyConfig(Ranged):
    """One flight."""

    link: LinkConfig = field(default_factory=LinkConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    rates: Rates = field(default_factory=Rates)
    limits: Limits = field(default_factory=Limits)
    envelope: EnvelopeConfig = field(default_factory=EnvelopeConfig)
    setpoints: SetpointLimits = field(default_factory=SetpointLimits)
    arm: Annotated[bool, Parameter(group=ENGAGING)] = False
    """Arm and engage once, as soon as everything is ready."""
    mode: Annotated[str | None, Parameter(group=ENGAGING)] = None
    """Flight mode to request when engaging; default: one that is allowed."""
    takeoff: Annotated[float | None, Parameter(group=ENGAGING), Between(0.5, 100, "m")] = None
    """With --arm: metres to climb by the autopilot's own takeoff first."""
    goal: Annotated[
        str | None, Parameter(group=ENGAGING, allow_leading_hyphen=True, show_default=False)
    ] = None
    """NORTH,EAST,DOWN of the goal, in metres from the estimator's origin."""
    engage_channel: Annotated[int | None, Parameter(group=ENGAGING), Between(5, 18)] = None
    """Radio channel, from 5, whose switch engages (high) and releases (low)."""
    engage_on_arm: Annotated[bool, Parameter(group=ENGAGING)] = False
    """Engage when the vehicle is armed for the first time."""
    on_fault: Annotated[OnFault, Parameter(group=ENGAGING, show_choices=False)] = "auto"
    """After a fault of ours: auto, release, hold, land or rtl."""
    then: Annotated[OnFault, Parameter(group=ENGAGING, show_choices=False)] = "auto"
    """After a normal end: auto, release, hold, land or rtl."""
    duration: Annotated[float | None, Parameter(group=ENGAGING), Between(0.1, 86400, "s")] = None
    """Seconds to fly from the policy's first action; default: until Ctrl-C."""
    rerun: Annotated[str, Parameter(group=OUTPUT)] = "off"
    """Rerun viewer: spawn, connect[=URL], FILE.rrd or off."""
    gates: Annotated[Path | None, Parameter(group=OUTPUT)] = None
    """JSON of the course's gates: shown, counted, and the flight ends after the last one."""
    record: Annotated[Path | None, Parameter(group=OUTPUT)] = None
    """New folder for the recorded flight; needs the extra "record"."""
    report: Annotated[Path | None, Parameter(group=OUTPUT)] = None
    """JSON file for the timing report."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.takeoff is not None and not self.arm:
            raise UserError("--takeoff needs --arm: nothing else takes off by itself")
        _ = self.goal_ned_m
        engages = self.arm or self.engage_on_arm or self.engage_channel is not None
        if self.link.readonly and (engages or self.mode is not None):
            raise UserError(
                "--readonly sends nothing, so it cannot be used with --arm, --mode, "
                "--engage-channel or --engage-on-arm"
            )

    @property
    def goal_ned_m(self) -> tuple[float, float, float] | None:
        """Goal of ``--goal``; raises UserError unless it is three numbers."""
        if self.goal is None:
            return None
        try:
            north, east, down = (float(text) for text in self.goal.split(","))
        except ValueError:
            north = east = down = math.nan
        if not all(abs(metres) < MAX_GOAL_M for metres in (north, east, down)):  # also of NaN
            raise UserError(
                f"--goal {self.goal} is not understood: use NORTH,EAST,DOWN in metres, such as "
                "20,0,-5 for 20 m north and 5 m up"
            )
        return north, east, down
