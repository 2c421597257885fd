"""Profile of ArduCopter 4.5 to 4.7."""

from collections.abc import Iterator, Mapping
from typing import ClassVar

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.reasons import Code, because
from mavbridge.core.vehicle import ModeRoles, Output, StickGains
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import CommandRequest
from mavbridge.mavlink.profiles.ardupilot_sticks import (
    OPTION_CHANNELS,
    SIMPLE_NAMES,
    STICKS,
    ardupilot_curves,
    calibration,
    is_simple_setting,
    map_notes,
    stick_names,
    stick_notes,
    takeoff_notes,
)
from mavbridge.mavlink.profiles.profile import (
    ModeTable,
    ParamContext,
    ParamNote,
    Profile,
    StreamGroup,
    Traits,
    clipped_note,
    condition_streams,
    timeout_notes,
)
from mavbridge.mavlink.profiles.sticks import StickCurves

RC_CHANNELS_HZ = 1000 / 17
"""Rate of RC_CHANNELS for the echo check, which needs at least 20 Hz: every 17 ms (ArduPilot counts
in whole ms), so that no joystick at a usual rate (10, 20, 25, 50 Hz) is in step with it and hides
between two samples. Costs 3.2 kB/s."""
HEARTBEAT_HZ = 10.0
"""Shows arming within 100 ms despite one lost packet (at 1 Hz within 1 s); a mode change is sent at
once at any rate."""

_OVERRIDE_SWITCH_OPTION = 46
"""RCn_OPTION "RC Override Enable": overrides are refused while the switch is low."""
_IGNORE_RECEIVER, _IGNORE_OVERRIDES, _REVERSE_SWITCHES = 1, 2, 128
"""Bits 0, 1 and 7 of RC_OPTIONS."""
_THRUST_AS_THRUST = 8
"""Bit 3 of GUID_OPTIONS; without it, thrust in SET_ATTITUDE_TARGET is a climb rate."""
_NO_VELOCITY = 32
"""Bit 5 of GUID_OPTIONS, "Do not stabilize VelocityXY"."""
_CONTINUE_LANDING = 8
"""Bit 3 of FS_OPTIONS."""

_FIRST_NAMES = (
    *(f"RCMAP_{stick}" for stick in STICKS),
    *("RC_OVERRIDE_TIME", "RC_OPTIONS", "FS_THR_ENABLE", "FLTMODE_CH"),
    *("RC_FS_TIMEOUT", "FS_THR_VALUE", "FS_OPTIONS", "THR_DZ", "MAV_GCS_SYSID_HI"),
    *("GUID_OPTIONS", "GUID_TIMEOUT", "ATC_ANGLE_BOOST", "MOT_THST_HOVER", "Q_ENABLE"),
    *("PILOT_Y_RATE", "PILOT_Y_EXPO", "ATC_RATE_Y_MAX"),
    *("MAV_GCS_SYSID", "ATC_ANGLE_MAX", "PILOT_SPD_UP", "PILOT_SPD_DN", "PILOT_TKO_ALT_M"),
    # the same up to 4.6
    *("SYSID_MYGCS", "ANGLE_MAX", "PILOT_SPEED_UP", "PILOT_SPEED_DN", "PILOT_TKOFF_ALT"),
    *(f"RC{number}_OPTION" for number in OPTION_CHANNELS),
)
"""Parameters to read first; RCMAP_* then selects the RCn_MIN etc. to read."""

_SIMPLE_MODE_OFF = (3.0, 0.0)
"""Auxiliary function and switch position (low)."""

_MODE_NAMES = {
    number: entry.name.removeprefix("COPTER_MODE_")
    for number, entry in dialect.enums["COPTER_MODE"].items()
    if not entry.name.endswith("ENUM_END")
}
_MODES = ModeTable(
    _MODE_NAMES,
    {name: (number, 0) for number, name in _MODE_NAMES.items()},
    roles=ModeRoles(
        names=tuple(_MODE_NAMES.values()),
        hold="BRAKE",
        land="LAND",
        rtl="RTL",
        takeoff=("GUIDED",),
        thrust=("STABILIZE", "ACRO", "DRIFT"),
        setpoint=("GUIDED", "GUIDED_NOGPS"),
    ),
)


class ArduPilot(Profile):
    """ArduCopter, as measured: sticks as PWM through its radio calibration, setpoints in GUIDED."""

    name = "ardupilot"
    modes = _MODES
    stick_output: ClassVar[Output] = "rc-override"
    refusal = "ArduPilot cannot release a MANUAL_CONTROL: use --output rc-override"
    params = _FIRST_NAMES
    target_hz = 50.0
    stick_echo = StreamGroup(("RC_CHANNELS",), RC_CHANNELS_HZ, is_needed=True)
    """Shows overrides exactly."""
    hover_param = "MOT_THST_HOVER"

    def streams(self, *, state_hz: float, pilot_hz: float | None = None) -> tuple[StreamGroup, ...]:
        """See `Profile`. The IMU is requested in floats first."""
        attitude = ("ATTITUDE_QUATERNION", "ATTITUDE")
        imu = ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU2")
        late = "a takeover whose packet is lost, and a disarming, are seen up to 1 s late"
        return (
            StreamGroup(attitude, state_hz, is_needed=True),
            StreamGroup(("LOCAL_POSITION_NED",), state_hz, is_needed=True),
            StreamGroup(imu, state_hz, is_needed=True),
            self.stick_echo._replace(rate_hz=pilot_hz or RC_CHANNELS_HZ),
            *condition_streams("EKF_STATUS_REPORT"),
            StreamGroup(("HEARTBEAT",), HEARTBEAT_HZ, without=late),
        )

    def needed_params(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """See `Profile`."""
        switch = self.traits(values).override_switch
        reversed_ = () if switch is None else (f"RC{switch}_REVERSED",)
        others = (*super().needed_params(values), *reversed_, *SIMPLE_NAMES)
        return (*stick_names(values, "OPTION"), *others)

    def calibration(self, values: Mapping[str, float]) -> RcCalibration:
        """Return the calibration from RCMAP_* and RCn_*."""
        return calibration(values)

    def traits(self, values: Mapping[str, float]) -> Traits:
        """See `Profile`."""
        options = {number: values.get(f"RC{number}_OPTION") for number in OPTION_CHANNELS}
        switches = [n for n, option in options.items() if option == _OVERRIDE_SWITCH_OPTION]
        return Traits(
            override_switch=switches[0] if switches else None,
            ignores_receiver=bool(int(values.get("RC_OPTIONS", 0)) & _IGNORE_RECEIVER),
            keeps_sticks=values.get("FS_THR_ENABLE") == 0,
            boosts_thrust=values.get("ATC_ANGLE_BOOST", 1.0) != 0,
        )

    def follow_up(self, name: str, before: float, now: float) -> CommandRequest | None:
        """Return "Simple mode off": without it the mode stays on until the mode switch moves."""
        if is_simple_setting(name, before) and not is_simple_setting(name, now):
            return CommandRequest(dialect.MAV_CMD_DO_AUX_FUNCTION, _SIMPLE_MODE_OFF)
        return None

    def notes(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """See `Profile`."""
        if "Q_ENABLE" in values:  # with Q_MAV_TYPE 2 its heartbeat is a quadrotor's
            said = "this is an ArduPlane, and only the modes of ArduCopter are known"
            yield ParamNote("obstacle", ("Q_ENABLE",), said)
        if context.output == "rc-override":
            yield from _override_notes(values, context, self.traits(values).override_switch)
        elif context.output is not None:
            yield from _setpoint_notes(values, context)

    def stick_curves(
        self, values: Mapping[str, float], mode: str, gains: StickGains | None
    ) -> StickCurves:
        """Return the curves of lean, yaw rate and climb rate in ALT_HOLD and STABILIZE."""
        return ardupilot_curves(values, mode, gains)

    def takeoff(self, height_m: float, amsl_m: float | None) -> CommandRequest:
        """Return NAV_TAKEOFF for GUIDED; its height counts from home, the arming place."""
        return CommandRequest(dialect.MAV_CMD_NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, height_m))


def _override_notes(
    values: Mapping[str, float], context: ParamContext, switch: int | None
) -> Iterator[ParamNote]:
    """Yield what ignores, turns or keeps overrides; ``switch``: channel that enables them."""
    name = "SYSID_MYGCS" if "SYSID_MYGCS" in values else "MAV_GCS_SYSID"
    yield ParamNote("wanted", (name,), f"{context.source_system}, our system id")
    if (low := values.get(name)) is not None:
        high = max(values.get("MAV_GCS_SYSID_HI", 0), low)
        if not low <= context.source_system <= high:
            said = f"it obeys system {low:.0f} and we are system {context.source_system}"
            cure, or_else = f"--set-config link.source_system={low:.0f}", f", or set {name}"
            yield ParamNote("obstacle", (name,), said, cure, or_else)
    yield ParamNote("wanted", ("RC_OPTIONS",), "bit 1 clear")
    options = int(values.get("RC_OPTIONS", 0))
    reverses = _REVERSE_SWITCHES if values.get(f"RC{switch}_REVERSED") else 0
    for bit, effect in (
        (_IGNORE_OVERRIDES, ", whose bit 1 ignores overrides"),
        (reverses, f", whose bit 7 reverses RC{switch}, the override switch"),
    ):
        if options & bit:
            yield ParamNote.of("obstacle", "RC_OPTIONS", options, effect, options & ~bit)
    yield from map_notes(values, context.booted)
    yield from stick_notes(values)
    yield from takeoff_notes(values)
    yield from clipped_note(values, "ATC_RATE_Y_MAX", "PILOT_Y_RATE")
    yield from _timeout_notes(values, context)
    landing = values.get("FS_OPTIONS", _CONTINUE_LANDING)
    yield ParamNote("wanted", ("FS_OPTIONS",), "any" if context.has_receiver else "24 (bit 3 set)")
    if context.has_receiver is False and not int(landing) & _CONTINUE_LANDING:
        effect = ": without a receiver, a landing turns into RTL when the sticks end"
        mended = int(landing) | _CONTINUE_LANDING
        yield ParamNote.of("hint", "FS_OPTIONS", landing, effect, mended)
    if switch is not None:
        yield ParamNote("wanted", (f"RC{switch}_OPTION",), "46, with its switch on")
    elif context.has_receiver:
        said = "no RCn_OPTION is 46: a switch of the radio with it takes the sticks back in the "
        said += "autopilot itself, whatever happens here"
        yield ParamNote("hint", ("RCn_OPTION",), said)


def _timeout_notes(values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
    """Yield what ends overrides too early, too late or never."""
    name, time_s = "RC_OVERRIDE_TIME", values.get("RC_OVERRIDE_TIME", 1.0)
    if time_s == 0:
        yield ParamNote.of("obstacle", name, time_s, ", which disables overrides", 0.5)
    if time_s < 0:
        why = because(Code.ENDLESS_OVERRIDE, time_s=time_s)
        yield ParamNote.of_risk("endless-override", why, name, f"--set {name}=0.5")
    yield from timeout_notes(values, name, "hold its last sticks")
    if context.has_receiver is False:  # overrides that have ended are then kept until the failsafe
        yield from timeout_notes(values, "RC_FS_TIMEOUT", "hold its last sticks")
    failsafe = "not 0" if context.has_receiver else "not 0, without a receiver"
    yield ParamNote("wanted", ("FS_THR_ENABLE",), failsafe)
    if values.get("FS_THR_ENABLE") == 0 and context.has_receiver is not True:
        why, name = because(Code.NO_THROTTLE_FAILSAFE), "FS_THR_ENABLE"
        yield ParamNote.of_risk("no-throttle-failsafe", why, name, f"--set {name}=1")


def _setpoint_notes(values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
    """Yield what misreads, keeps or weakens setpoints in GUIDED."""
    options = values.get("GUID_OPTIONS")
    if context.output != "velocity":
        yield ParamNote("wanted", ("GUID_OPTIONS",), "bit 3 (8) set")
        boost = "1, or as in training" if context.output == "attitude" else "any"
        yield ParamNote("wanted", ("ATC_ANGLE_BOOST",), boost)
    if context.output == "velocity":
        if options is not None and int(options) & _NO_VELOCITY:
            effect = ", with which it ignores our velocity to the north and east"
            mended = int(options) & ~_NO_VELOCITY
            yield ParamNote.of("obstacle", "GUID_OPTIONS", options, effect, mended)
    elif options is None:
        said = "it has not sent GUID_OPTIONS, which is asked for again"
        yield ParamNote("obstacle", ("GUID_OPTIONS",), said)
    elif not int(options) & _THRUST_AS_THRUST:
        effect = ", with which it takes our thrust for a climb rate"
        mended = int(options) | _THRUST_AS_THRUST
        yield ParamNote.of("obstacle", "GUID_OPTIONS", options, effect, mended)
    yield from timeout_notes(values, "GUID_TIMEOUT", "hold its last setpoint", is_setpoint=True)
    yield ParamNote("wanted", ("FS_THR_ENABLE",), "not 0" if context.has_receiver else "0")
    failsafe = values.get("FS_THR_ENABLE", 0.0)
    if context.has_receiver is False and failsafe != 0:
        effect = ": no receiver was seen, and it will not arm without one; setpoints need none"
        yield ParamNote.of("advice", "FS_THR_ENABLE", failsafe, effect, 0)
    if context.output == "attitude" and values.get("ATC_ANGLE_BOOST") == 0:
        effect = ": thrust is not raised when it leans, the policy has to do it"
        yield ParamNote.of("advice", "ATC_ANGLE_BOOST", 0.0, effect)


ARDUPILOT = ArduPilot()
