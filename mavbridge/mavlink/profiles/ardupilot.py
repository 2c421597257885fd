"""Profile of ArduCopter 4.5 to 4.7."""

from collections.abc import Iterator, Mapping
from typing import ClassVar

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.reasons import Code, because
from mavbridge.core.vehicle import ActionKind, ModeRoles, Output, StickGains
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import CommandRequest
from mavbridge.mavlink.profiles.ardupilot_sticks import (
    OPTION_CHANNELS,
    SIMPLE_NAMES,
    STICKS,
    TURNED,
    ardupilot_curves,
    calibration,
    calibration_names,
    is_simple_setting,
    stick_settings,
)
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
    stick_obstacles,
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

_OVERRIDE_SWITCH_OPTION = 46
"""RCn_OPTION "RC Override Enable": overrides are refused while the switch is low."""
_IGNORE_RECEIVER, _IGNORE_OVERRIDES = 1, 2
"""Bits 0 and 1 of RC_OPTIONS."""
_THRUST_AS_THRUST = 8
"""Bit 3 of GUID_OPTIONS; without it, thrust in SET_ATTITUDE_TARGET is a climb rate."""
_CONTINUE_LANDING = 8
"""Bit 3 of FS_OPTIONS."""
_LONGEST_S = 1.0
"""Longest useful timeout; a longer one leaves the vehicle uncontrolled longer than necessary."""

_OLD_NAMES = {
    "MAV_GCS_SYSID": "SYSID_MYGCS",
    "ATC_ANGLE_MAX": "ANGLE_MAX",
    "PILOT_SPD_UP": "PILOT_SPEED_UP",
    "PILOT_SPD_DN": "PILOT_SPEED_DN",
}
"""Names since 4.7, with those up to 4.6."""

_RISK_NAMES = ("RC_OVERRIDE_TIME", "RC_OPTIONS", "FS_THR_ENABLE")
"""Parameters that decide a flight's safety: requested again if the first requests get lost."""

_FIRST_NAMES = (
    *(f"RCMAP_{stick}" for stick in STICKS),
    *_RISK_NAMES,
    "FLTMODE_CH",
    *("RC_FS_TIMEOUT", "FS_THR_VALUE", "FS_OPTIONS", "THR_DZ", "MAV_GCS_SYSID_HI"),
    *("GUID_OPTIONS", "GUID_TIMEOUT", "ATC_ANGLE_BOOST", "MOT_THST_HOVER"),
    *("PILOT_Y_RATE", "PILOT_Y_EXPO"),
    *_OLD_NAMES,
    *_OLD_NAMES.values(),
    *(f"RC{number}_OPTION" for number in OPTION_CHANNELS),
)
"""Parameters to read first; RCMAP_* then selects the RCn_MIN etc. to read."""

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
    params = _FIRST_NAMES

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
        known = (values.get(f"RCMAP_{stick}") for stick in STICKS)
        dead_zones = (f"RC{int(number)}_DZ" for number in known if number is not None)
        settings = (each.name for each in stick_settings(values))
        more = (name for name in settings if name not in _FIRST_NAMES)
        return (*calibration_names(values), *dead_zones, *more)

    def needed_params(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Return the calibration's parameters, and those that decide a flight's safety."""
        thrust_names = ("GUID_OPTIONS", "ATC_ANGLE_BOOST", "MOT_THST_HOVER")
        return (*calibration_names(values), *_RISK_NAMES, *thrust_names)

    def calibration(self, values: Mapping[str, float]) -> RcCalibration:
        """Return the calibration from RCMAP_* and RCn_*."""
        return calibration(values)

    def override_switch(self, values: Mapping[str, float]) -> int | None:
        """Return the channel with RCn_OPTION 46, or None."""
        options = {number: values.get(f"RC{number}_OPTION") for number in OPTION_CHANNELS}
        return next((n for n, option in options.items() if option == _OVERRIDE_SWITCH_OPTION), None)

    def ignores_receiver(self, values: Mapping[str, float]) -> bool:
        """True if bit 0 of RC_OPTIONS is set."""
        return bool(int(values.get("RC_OPTIONS", 0)) & _IGNORE_RECEIVER)

    def follow_up(self, name: str, before: float, now: float) -> CommandRequest | None:
        """Return "Simple mode off": without it the mode stays on until the mode switch moves."""
        if is_simple_setting(name, before) and not is_simple_setting(name, now):
            return CommandRequest(dialect.MAV_CMD_DO_AUX_FUNCTION, _SIMPLE_MODE_OFF)
        return None

    def obstacles(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Yield settings that ignore or turn overrides, or take thrust for a climb rate."""
        if context.output == "rc-override":
            yield from _override_obstacles(values, context.source_system)
        elif context.output in ("attitude", "rates"):
            options = values.get("GUID_OPTIONS")
            if options is None:
                yield ParamNote(
                    ("GUID_OPTIONS",), "it has not sent GUID_OPTIONS, which is asked for again"
                )
            elif not int(options) & _THRUST_AS_THRUST:
                yield ParamNote(
                    ("GUID_OPTIONS",),
                    f"GUID_OPTIONS is {options:g}, with which it takes our thrust for a climb rate",
                    f"--set GUID_OPTIONS={int(options) | _THRUST_AS_THRUST}",
                )

    def dangers(self, values: Mapping[str, float], context: ParamContext) -> Iterator[Danger]:
        """Yield settings under which sticks would stay for ever, or setpoints for long."""
        if context.output == "rc-override":
            time_s = values.get("RC_OVERRIDE_TIME")
            if time_s is not None and time_s < 0:
                why = because(Code.ENDLESS_OVERRIDE, time_s=time_s)
                yield Danger(
                    "endless-override", why, "RC_OVERRIDE_TIME", "--set RC_OVERRIDE_TIME=0.5"
                )
            if values.get("FS_THR_ENABLE") == 0 and context.has_receiver is not True:
                why = because(Code.NO_THROTTLE_FAILSAFE)
                yield Danger("no-throttle-failsafe", why, "FS_THR_ENABLE", "--set FS_THR_ENABLE=1")
        elif context.output is not None:
            yield from setpoint_danger(values, "GUID_TIMEOUT")

    def advice(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Yield long timeouts, and obstacles to arming."""
        if context.output == "rc-override":
            yield from _override_advice(values)
        elif context.output is not None:
            yield from _setpoint_advice(values, context)

    def hints(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Yield failsafes and switches that make a flight safer."""
        if context.output != "rc-override":
            return
        options = values.get("FS_OPTIONS")
        lands_on = options is None or int(options) & _CONTINUE_LANDING
        if context.has_receiver is False and options is not None and not lands_on:
            yield ParamNote(
                ("FS_OPTIONS",),
                f"FS_OPTIONS is {options:g}: without a receiver, a landing turns into RTL when the "
                "sticks end",
                f"--set FS_OPTIONS={int(options) | _CONTINUE_LANDING}",
            )
        if context.has_receiver and self.override_switch(values) is None:
            yield ParamNote(
                ("RCn_OPTION",),
                "no RCn_OPTION is 46: a switch of the radio with it takes the sticks back in the "
                "autopilot itself, whatever happens here",
            )

    def wanted_params(
        self, values: Mapping[str, float], context: ParamContext
    ) -> Iterator[WantedParam]:
        """Yield the parameters for overrides, or for setpoints."""
        if context.output == "rc-override":
            name = "SYSID_MYGCS" if "SYSID_MYGCS" in values else "MAV_GCS_SYSID"
            yield WantedParam(name, f"{context.source_system}, our system id")
            yield WantedParam("RC_OPTIONS", "bit 1 clear")
            yield WantedParam("RC_OVERRIDE_TIME", f"0.5; above 0, at most {_LONGEST_S:g} s")
            for name in SIMPLE_NAMES:
                yield WantedParam(name, "0")
            receiver = "" if context.has_receiver else ", without a receiver"
            yield WantedParam("FS_THR_ENABLE", f"not 0{receiver}")
            yield WantedParam("FS_OPTIONS", "any" if context.has_receiver else "24 (bit 3 set)")
            if (switch := self.override_switch(values)) is not None:
                yield WantedParam(f"RC{switch}_OPTION", "46, with its switch on")
            return
        yield WantedParam("GUID_TIMEOUT", f"0.5; at most {_LONGEST_S:g} s")
        yield WantedParam("FS_THR_ENABLE", "not 0" if context.has_receiver else "0")
        if context.output in ("attitude", "rates"):
            yield WantedParam("GUID_OPTIONS", "bit 3 (8) set")
            boost = "1, or as in training" if context.output == "attitude" else "any"
            yield WantedParam("ATC_ANGLE_BOOST", boost)

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


def _override_obstacles(values: Mapping[str, float], source_system: int) -> Iterator[ParamNote]:
    """Yield settings under which this vehicle would ignore our overrides."""
    low = values.get("MAV_GCS_SYSID", values.get("SYSID_MYGCS"))
    if low is not None:
        high = max(values.get("MAV_GCS_SYSID_HI", 0), low)
        if not low <= source_system <= high:
            yield ParamNote(
                ("MAV_GCS_SYSID", "SYSID_MYGCS"),
                f"it obeys system {low:.0f} and we are system {source_system}",
                f"--set-config link.source_system={low:.0f}",
                ", or set MAV_GCS_SYSID (SYSID_MYGCS on older firmware)",
            )
    options = int(values.get("RC_OPTIONS", 0))
    if options & _IGNORE_OVERRIDES:
        yield ParamNote(
            ("RC_OPTIONS",),
            "RC_OPTIONS bit 1 (ignore overrides) is set",
            f"--set RC_OPTIONS={options & ~_IGNORE_OVERRIDES}",
        )
    if values.get("RC_OVERRIDE_TIME") == 0:
        yield ParamNote(
            ("RC_OVERRIDE_TIME",),
            "RC_OVERRIDE_TIME is 0, which disables overrides",
            "--set RC_OVERRIDE_TIME=0.5",
        )
    yield from stick_obstacles(stick_settings(values), values)


def _override_advice(values: Mapping[str, float]) -> Iterator[ParamNote]:
    """Yield warnings before a flight by overrides."""
    missing = [name for name in _RISK_NAMES if name not in values]
    if missing:
        yield ParamNote(
            tuple(missing),
            f"the vehicle has not sent {', '.join(missing)}: whether it holds its last sticks for "
            "ever if this computer dies is not known",
        )
    if missing := [name for name in SIMPLE_NAMES if name not in values]:
        yield ParamNote(
            tuple(missing),
            f"the vehicle has not sent {', '.join(missing)}: whether {TURNED}the heading at "
            "arming is not known",
        )
    time_s = values.get("RC_OVERRIDE_TIME", 0.0)
    if time_s > _LONGEST_S:
        yield ParamNote(
            ("RC_OVERRIDE_TIME",),
            f"RC_OVERRIDE_TIME is {time_s:g}: if this computer died, the vehicle would hold its "
            "last sticks for that many seconds",
            "--set RC_OVERRIDE_TIME=0.5",
        )


def _setpoint_advice(values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
    """Yield warnings before a flight by setpoints in GUIDED."""
    timeout_s = values.get("GUID_TIMEOUT", 0.0)
    if timeout_s > _LONGEST_S:
        yield ParamNote(
            ("GUID_TIMEOUT",),
            f"GUID_TIMEOUT is {timeout_s:g}: if this computer died, the vehicle would hold its "
            "last setpoint for that many seconds",
            "--set GUID_TIMEOUT=0.5",
        )
    if context.has_receiver is False and values.get("FS_THR_ENABLE", 0.0) != 0:
        yield ParamNote(
            ("FS_THR_ENABLE",),
            "no receiver was seen: the vehicle will not arm without one while its throttle "
            "failsafe is on; setpoints do not need it",
            "--set FS_THR_ENABLE=0",
        )
    if context.output == "attitude" and values.get("ATC_ANGLE_BOOST") == 0:
        yield ParamNote(
            ("ATC_ANGLE_BOOST",),
            "ATC_ANGLE_BOOST is 0: thrust is not raised when it leans, the policy has to do it",
        )


ARDUPILOT = ArduPilot()
