"""Profile of ArduCopter 4.5 to 4.7."""

from collections.abc import Iterator, Mapping
from typing import ClassVar

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.vehicle import ActionKind, ModeRoles, Output, StickGains
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import CommandRequest
from mavbridge.mavlink.profiles import ardupilot_params
from mavbridge.mavlink.profiles.ardupilot_sticks import ardupilot_curves
from mavbridge.mavlink.profiles.profile import (
    NO_HEALTH,
    NO_LANDING,
    NO_POSITION_WORD,
    Danger,
    ModeTable,
    ParamContext,
    ParamNote,
    Profile,
    StreamGroup,
    WantedParam,
    optional_stream,
    setpoint_danger,
)
from mavbridge.mavlink.profiles.sticks import StickCurves

RC_CHANNELS_HZ = 1000 / 17
"""Rate of RC_CHANNELS for the echo check, which needs at least 20 Hz: every 17 ms (ArduPilot counts
in whole ms), so that no joystick at a usual rate (10, 20, 25, 50 Hz) is in step with it and hides
between two samples. Costs 3.2 kB/s."""
HEARTBEAT_HZ = 10.0
"""Shows arming within 100 ms despite one lost packet (at 1 Hz within 1 s); a mode change is sent at
once at any rate."""
_TARGET_HZ = 50.0
"""Rate of ATTITUDE_TARGET and POSITION_TARGET_LOCAL_NED for the echo check."""

_SIMPLE_MODE_OFF = (3.0, 0.0)
"""Auxiliary function and switch position (low)."""

_MODES = ModeTable(
    {
        number: entry.name.removeprefix("COPTER_MODE_")
        for number, entry in dialect.enums["COPTER_MODE"].items()
        if not entry.name.endswith("ENUM_END")
    },
    roles=ModeRoles(
        hold="BRAKE",
        land="LAND",
        rtl="RTL",
        takeoff=("GUIDED",),
        thrust=("STABILIZE", "ACRO"),
        setpoint=("GUIDED", "GUIDED_NOGPS"),
    ),
)


class ArduPilot(Profile):
    """ArduCopter, as measured: sticks as PWM through its radio calibration, setpoints in GUIDED."""

    name = "ardupilot"
    modes = _MODES
    outputs: ClassVar[Mapping[ActionKind, Output]] = {
        "sticks": "rc-override",
        "rates": "rates",
        "attitude": "attitude",
        "velocity": "velocity",
    }
    refusals: ClassVar[Mapping[Output, str]] = {
        "manual-control": "ArduPilot cannot release a MANUAL_CONTROL: use --output rc-override"
    }
    params = ardupilot_params.FIRST_NAMES

    def streams(self, *, state_hz: float, pilot_hz: float | None = None) -> tuple[StreamGroup, ...]:
        """See `Profile`. Legacy streams serve links on which no command is acknowledged.

        The IMU is requested in floats first.
        """
        attitude, imu, radio = (
            ("ATTITUDE_QUATERNION", "ATTITUDE"),
            ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU2"),
            ("RC_CHANNELS",),
        )
        return (
            StreamGroup(attitude, dialect.MAV_DATA_STREAM_EXTRA1, state_hz),
            StreamGroup(("LOCAL_POSITION_NED",), dialect.MAV_DATA_STREAM_POSITION, state_hz),
            StreamGroup(imu, dialect.MAV_DATA_STREAM_RAW_SENSORS, state_hz),
            StreamGroup(radio, dialect.MAV_DATA_STREAM_RC_CHANNELS, pilot_hz or RC_CHANNELS_HZ),
            optional_stream("SYS_STATUS", 2.0, without=NO_HEALTH),
            optional_stream("EXTENDED_SYS_STATE", 5.0, without=NO_LANDING),
            optional_stream("EKF_STATUS_REPORT", 5.0, without=NO_POSITION_WORD),
            optional_stream("HEARTBEAT", HEARTBEAT_HZ),
        )

    def echo(self, output: Output) -> StreamGroup:
        """See `Profile`. RC_CHANNELS shows overrides exactly; targets are shown after shaping."""
        if output in ("attitude", "rates"):
            return optional_stream("ATTITUDE_TARGET", _TARGET_HZ)
        if output == "velocity":
            return optional_stream("POSITION_TARGET_LOCAL_NED", _TARGET_HZ, least_hz=0.0)
        legacy = dialect.MAV_DATA_STREAM_RC_CHANNELS
        return StreamGroup(("RC_CHANNELS",), legacy, RC_CHANNELS_HZ)

    def more_params(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Return calibration, dead zones and stick settings of RCMAP_*'s channels."""
        names = ardupilot_params.calibration_names(values)
        settings = ardupilot_params.stick_setting_names(values)
        return names + ardupilot_params.dead_zone_names(values) + settings

    def needed_params(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Return the calibration's parameters, and those that decide a flight's safety."""
        names = ardupilot_params.calibration_names(values)
        thrust_names = ("GUID_OPTIONS", "ATC_ANGLE_BOOST", "MOT_THST_HOVER")
        return (*names, *ardupilot_params.RISK_NAMES, *thrust_names)

    def calibration(self, values: Mapping[str, float]) -> RcCalibration:
        """Return the calibration from RCMAP_* and RCn_*."""
        return ardupilot_params.calibration(values)

    def override_switch(self, values: Mapping[str, float]) -> int | None:
        """Return the channel with RCn_OPTION 46, or None."""
        return ardupilot_params.override_switch(values)

    def ignores_receiver(self, values: Mapping[str, float]) -> bool:
        """True if bit 0 of RC_OPTIONS is set."""
        return bool(int(values.get("RC_OPTIONS", 0)) & ardupilot_params.IGNORE_RECEIVER)

    def follow_up(self, name: str, before: float, now: float) -> CommandRequest | None:
        """Return "Simple mode off": without it the mode stays on until the mode switch moves."""
        is_simple = ardupilot_params.is_simple_setting
        if is_simple(name, before) and not is_simple(name, now):
            return CommandRequest(dialect.MAV_CMD_DO_AUX_FUNCTION, _SIMPLE_MODE_OFF)
        return None

    def obstacles(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Yield settings that ignore or turn overrides, or take thrust for a climb rate."""
        if context.output == "rc-override":
            yield from ardupilot_params.override_obstacles(values, context.source_system)
        elif context.output in ("attitude", "rates"):
            yield from ardupilot_params.thrust_obstacles(values)

    def dangers(self, values: Mapping[str, float], context: ParamContext) -> Iterator[Danger]:
        """Yield settings under which sticks would stay for ever, or setpoints for long."""
        if context.output == "rc-override":
            yield from ardupilot_params.override_dangers(values, has_receiver=context.has_receiver)
        elif context.output is not None:
            yield from setpoint_danger(values, "GUID_TIMEOUT")

    def advice(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Yield long timeouts, and obstacles to arming."""
        if context.output == "rc-override":
            yield from ardupilot_params.override_advice(values)
        elif context.output is not None:
            yield from ardupilot_params.setpoint_advice(values, context)

    def hints(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Yield failsafes and switches that make a flight safer."""
        return ardupilot_params.hints(values, context)

    def wanted_params(
        self, values: Mapping[str, float], context: ParamContext
    ) -> Iterator[WantedParam]:
        """Yield the parameters for overrides, or for setpoints."""
        return ardupilot_params.wanted_params(values, context)

    def stick_curves(
        self, values: Mapping[str, float], mode: str, gains: StickGains | None
    ) -> StickCurves:
        """Return the curves of lean, yaw rate and climb rate in ALT_HOLD and STABILIZE."""
        return ardupilot_curves(values, mode, gains)

    def hover_thrust(self, values: Mapping[str, float]) -> float | None:
        """Return MOT_THST_HOVER, which the vehicle learns in flight."""
        return values.get("MOT_THST_HOVER")

    def boosts_thrust(self, values: Mapping[str, float]) -> bool:
        """True unless ATC_ANGLE_BOOST is 0."""
        return values.get("ATC_ANGLE_BOOST", 1.0) != 0

    def takeoff(self, height_m: float, amsl_m: float | None) -> CommandRequest:
        """Return NAV_TAKEOFF for GUIDED; its height counts from home, the arming place."""
        return CommandRequest(dialect.MAV_CMD_NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, height_m))


ARDUPILOT = ArduPilot()
