"""Profile of PX4's multicopters, measured on 1.18."""

import math
from collections.abc import Iterator, Mapping
from typing import ClassVar

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.vehicle import ActionKind, ModeRoles, Output, StickGains
from mavbridge.mavlink.codec.messages import CommandRequest
from mavbridge.mavlink.profiles.profile import (
    NO_HEALTH,
    NO_LANDING,
    NO_POSITION_WORD,
    Danger,
    EventMeaning,
    ModeTable,
    ParamContext,
    ParamNote,
    Profile,
    StickSetting,
    StreamGroup,
    WantedParam,
    optional_stream,
    setpoint_danger,
    stick_obstacles,
)
from mavbridge.mavlink.profiles.px4_sticks import px4_curves
from mavbridge.mavlink.profiles.sticks import StickCurves

CURRENT_MODE_HZ = 50.0
"""Shows a mode change within 30 ms; the unrequested rate is 2 Hz."""
RC_CHANNELS_HZ = 20.0
"""Rate for the switches of a radio."""
POSITION_CEILING_HZ = 125.0
"""Highest rate of the estimator's position and of targets, also if more is requested."""
FAST_HZ = 250.0
"""Rate of attitude and IMU. A stream is sent at a whole number of steps of the link's clock: 200 Hz
requested become 125 Hz, 250 Hz become 205 to 250 Hz."""
_UNEVEN_HZ = 150.0
"""Rate above which a request for the rate itself yields less than one for ``FAST_HZ``."""
_TARGET_HZ = 100.0
_NO_MAVLINK_STICKS = {0: "RC only", 4: "sticks disabled"}
"""Values of COM_RC_IN_MODE that exclude MAVLink's sticks."""
_STICK_SETTINGS = (
    StickSetting(
        "MAN_KILL_GEST_T",
        "both sticks held down and outwards stop the motors, in flight too",
        lambda time_s: time_s < 0,
        -1,
    ),
)
_NO_RESCALE = 1
"""Value of MPC_THR_CURVE."""
_FATAL_ACTIONS = {5: "terminate the flight", 6: "disarm"}
"""Values of NAV_RCL_ACT."""
_FATAL_OFFBOARD_ACTIONS = {6: "terminate the flight", 7: "disarm"}
"""Values of COM_OBL_RC_ACT."""
_EXCEPT_HOLD, _EXCEPT_OFFBOARD = 2, 4
"""Bits of COM_RCL_EXCEPT: modes in which the loss of sticks is no failsafe."""
_LONGEST_S = 1.0
_SHORTEST_S = 0.3
"""Shortest safe timeout: a guard on a busy computer may be late by a tenth of it, and a link may
lose a few packets in a row."""
_SLOWEST_HAND_PER_S = 0.05
"""Default if neither parameter was read: the minimum of COM_RC_STICK_OV, 5 %."""

_FIRST_MODES = ("MANUAL", "ALTCTL", "POSCTL", "AUTO", "ACRO", "OFFBOARD", "STABILIZED")
_AUTO_MODES = ("TAKEOFF", "LOITER", "MISSION", "RTL", "LAND")
_MODES = ModeTable(
    {
        **dict(enumerate(_FIRST_MODES, start=1)),
        10: "TERMINATION",
        11: "ALTITUDE_CRUISE",
    },
    roles=ModeRoles(
        hold="AUTO.LOITER",
        land="AUTO.LAND",
        rtl="AUTO.RTL",
        takeoff=("AUTO.LOITER", "AUTO.TAKEOFF"),
        thrust=("MANUAL", "STABILIZED", "ACRO"),
        setpoint=("OFFBOARD",),
        needs_setpoints_first=True,
        is_silence_failsafe=True,
        override="POSCTL",
        needs_sticks_first=True,
    ),
    shift=16,
    sub_shift=24,
    sub_modes={"AUTO": dict(enumerate(_AUTO_MODES, start=2))},
    never_commanded=("TERMINATION",),
)


def event_id(name: str) -> int:
    """Return the number of an EVENT of the autopilot (PX4's guide to its events interface).

    Highest byte: 1. Lower 24 bits: those of the 32-bit FNV-1a hash of its name.
    """
    number = 0x811C9DC5
    for byte in name.encode():
        number = (number ^ byte) * 0x01000193 & 0xFFFFFFFF
    return 1 << 24 | number & 0xFFFFFF


_EVENTS = {
    "commander_armed_by": EventMeaning(is_armed=True),
    "commander_disarmed_by": EventMeaning(is_armed=False),
    "commander_failsafe_enter": EventMeaning(is_failsafe=True),
    "commander_failsafe_enter_hold": EventMeaning(is_failsafe=True),
    "commander_failsafe_enter_generic": EventMeaning(is_failsafe=True),
    "commander_failsafe_enter_generic_hold": EventMeaning(is_failsafe=True),
    "commander_failsafe_enter_autopilot_disengaged": EventMeaning(is_failsafe=True),
    "commander_rc_override": EventMeaning(is_stick_override=True),
    "commander_rc_lost": EventMeaning(text="manual control lost"),
    "commander_rc_regained": EventMeaning(text="manual control regained"),
}


class Px4(Profile):
    """PX4, as measured: sticks as MANUAL_CONTROL, setpoints in OFFBOARD."""

    name = "px4"
    modes = _MODES
    outputs: ClassVar[Mapping[ActionKind, Output]] = {
        "sticks": "manual-control",
        "rates": "rates",
        "attitude": "attitude",
        "velocity": "velocity",
    }
    refusals: ClassVar[Mapping[Output, str]] = {
        "rc-override": "PX4 cannot release an RC_CHANNELS_OVERRIDE: use --output manual-control"
    }
    heartbeat_type = dialect.MAV_TYPE_GCS
    """PX4 sends STATUSTEXT only on links with a ground station."""
    is_bytewise = True
    has_rc_channels_always = False
    events: ClassVar[Mapping[int, EventMeaning]] = {
        event_id(name): meaning for name, meaning in _EVENTS.items()
    }
    sends_invalid_estimates = True
    shows_rates = True
    params = (
        *("COM_RC_IN_MODE", "COM_RC_LOSS_T", "COM_RCL_EXCEPT", "NAV_RCL_ACT", "COM_FAIL_ACT_T"),
        *("COM_OF_LOSS_T", "COM_OBL_RC_ACT", "COM_DISARM_PRFLT", "COM_DISARM_LAND"),
        *("MAN_ARM_GESTURE", "MAN_OVERRIDE_SPD", "NAV_DLL_ACT", "MPC_THR_HOVER"),
        *("COM_RC_OVERRIDE", "COM_RC_STICK_OV"),
        *("MIS_TAKEOFF_ALT", "MPC_XY_MAN_EXPO", "MPC_VEL_MANUAL"),
        *("MPC_MAN_TILT_MAX", "MPC_MAN_Y_MAX", "MPC_YAW_EXPO", "MPC_Z_MAN_EXPO"),
        *("MPC_Z_VEL_MAX_UP", "MPC_Z_VEL_MAX_DN", "MAN_DEADZONE", "MPC_HOLD_DZ"),
        *("MAN_KILL_GEST_T", "MPC_TILTMAX_AIR", "MPC_THR_CURVE"),
    )

    def streams(self, *, state_hz: float, pilot_hz: float | None = None) -> tuple[StreamGroup, ...]:
        """See `Profile`. RC_CHANNELS needs a receiver, GLOBAL_POSITION_INT a position.

        The pilot's sticks come in MANUAL_CONTROL, requested by ``echo`` at their own rate.
        """
        fast_hz = state_hz if state_hz <= _UNEVEN_HZ else FAST_HZ
        slow_hz = min(state_hz, POSITION_CEILING_HZ)
        return (
            StreamGroup(("ATTITUDE_QUATERNION", "ATTITUDE"), None, fast_hz),
            StreamGroup(("LOCAL_POSITION_NED",), None, slow_hz),
            StreamGroup(("HIGHRES_IMU", "SCALED_IMU"), None, fast_hz),
            optional_stream(
                "CURRENT_MODE",
                CURRENT_MODE_HZ,
                least_hz=1.0,
                without="PX4 before 1.15, or MAVLink 1; a takeover shows in HEARTBEAT, which is "
                "asked for 20 times a second",
                stand_in="HEARTBEAT",
            ),
            optional_stream("RC_CHANNELS", pilot_hz or RC_CHANNELS_HZ, least_hz=0.0),
            optional_stream("SYS_STATUS", 2.0, without=NO_HEALTH),
            optional_stream("EXTENDED_SYS_STATE", 5.0, without=NO_LANDING),
            optional_stream("ESTIMATOR_STATUS", 5.0, without=NO_POSITION_WORD),
            optional_stream("GLOBAL_POSITION_INT", 2.0, least_hz=0.0),
        )

    def echo(self, output: Output) -> StreamGroup:
        """See `Profile`. MANUAL_CONTROL shows the selected sticks at the sender's rate."""
        if output in ("attitude", "rates"):
            return optional_stream("ATTITUDE_TARGET", _TARGET_HZ)
        if output == "velocity":
            return optional_stream("POSITION_TARGET_LOCAL_NED", _TARGET_HZ, least_hz=0.0)
        return optional_stream("MANUAL_CONTROL", FAST_HZ, least_hz=0.0)

    def needed_params(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Return the parameters for the source of sticks and for hover thrust."""
        return ("COM_RC_IN_MODE", "MPC_THR_HOVER")

    def ignores_receiver(self, values: Mapping[str, float]) -> bool:
        """True if COM_RC_IN_MODE is 1 (sticks only from MAVLink) or 4 (no sticks)."""
        return values.get("COM_RC_IN_MODE") in (1.0, 4.0)

    def obstacles(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Yield a COM_RC_IN_MODE without MAVLink's sticks, and a gesture a policy might make."""
        if context.output != "manual-control":
            return
        yield from stick_obstacles(_STICK_SETTINGS, values)
        mode = values.get("COM_RC_IN_MODE")
        if mode in _NO_MAVLINK_STICKS:
            yield ParamNote(
                ("COM_RC_IN_MODE",),
                f"COM_RC_IN_MODE is {mode:g} ({_NO_MAVLINK_STICKS[int(mode)]})",
                "--set COM_RC_IN_MODE=1",
                " (MAVLink only), or 6 with a receiver (MAVLink first)",
            )

    def dangers(self, values: Mapping[str, float], context: ParamContext) -> Iterator[Danger]:
        """Yield long setpoint timeouts; the end of sticks is always a failsafe."""
        if context.output not in (None, "manual-control"):
            yield from setpoint_danger(values, "COM_OF_LOSS_T")

    def advice(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Yield unexpected effects of the end of our packets."""
        if context.output == "manual-control":
            name, action = "COM_RC_LOSS_T", _FATAL_ACTIONS.get(int(values.get("NAV_RCL_ACT", 2)))
            act_name = "NAV_RCL_ACT"
            yield from _stick_advice(values)
        elif context.output is not None:
            name, act_name = "COM_OF_LOSS_T", "COM_OBL_RC_ACT"
            action = _FATAL_OFFBOARD_ACTIONS.get(int(values.get(act_name, 0)))
        else:
            return
        time_s = values.get(name, _LONGEST_S)
        if time_s > _LONGEST_S:
            yield ParamNote(
                (name,),
                f"{name} is {time_s:g}: if this computer died, the vehicle would go on with the "
                "last it was told for that many seconds",
                f"--set {name}=0.5",
            )
        if time_s < _SHORTEST_S:
            yield ParamNote(
                (name,),
                f"{name} is {time_s:g}: a pause of our packets as short as that is a failsafe",
            )
        if action is not None:
            yield ParamNote(
                (act_name,),
                f"{act_name} is {values[act_name]:g}: it would {action} if our packets stopped",
            )

    def hints(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Yield settings by which lost sticks end other modes, and the gesture that arms."""
        exceptions = values.get("COM_RCL_EXCEPT")
        is_sticks = context.output == "manual-control"
        bit, mode = (_EXCEPT_HOLD, "AUTO") if is_sticks else (_EXCEPT_OFFBOARD, "OFFBOARD")
        if exceptions is not None and not int(exceptions) & bit:
            yield ParamNote(
                ("COM_RCL_EXCEPT",),
                f"COM_RCL_EXCEPT is {exceptions:g}: sticks that were there at arming and end later "
                f"are a failsafe in {mode} modes too",
                f"--set COM_RCL_EXCEPT={int(exceptions) | bit}",
            )
        if is_sticks and values.get("MAN_ARM_GESTURE") == 1:
            yield ParamNote(
                ("MAN_ARM_GESTURE",),
                "MAN_ARM_GESTURE is 1: throttle down and full yaw for a second arms, which a "
                "policy on the ground might do",
                "--set MAN_ARM_GESTURE=0",
            )
        if not is_sticks and values.get("COM_OBL_RC_ACT") == 0:
            yield ParamNote(
                ("COM_OBL_RC_ACT",),
                "COM_OBL_RC_ACT is 0: when setpoints end it enters POSCTL if there are sticks, "
                "else RTL",
                "--set COM_OBL_RC_ACT=4",
                " (land), or 5 (hold)",
            )

    def wanted_params(
        self, values: Mapping[str, float], context: ParamContext
    ) -> Iterator[WantedParam]:
        """Yield the parameters for sticks, or for setpoints."""
        time = f"0.5; {_SHORTEST_S:g} to {_LONGEST_S:g} s"
        if context.output == "manual-control":
            yield WantedParam("COM_RC_IN_MODE", "1, or 6 with a receiver")
            yield WantedParam("COM_RC_LOSS_T", time)
            yield WantedParam("NAV_RCL_ACT", "1, 2 or 3 (hold, return, land)")
            yield WantedParam("COM_RCL_EXCEPT", f"with {_EXCEPT_HOLD} in it")
            yield WantedParam("MAN_ARM_GESTURE", "0")
            yield WantedParam("COM_DISARM_PRFLT", "longer than it takes to lift off")
        else:
            yield WantedParam("COM_OF_LOSS_T", time)
            yield WantedParam("COM_OBL_RC_ACT", "4 or 5 (land, hold)")
            yield WantedParam("COM_RCL_EXCEPT", f"with {_EXCEPT_OFFBOARD} in it")

    def stick_curves(
        self, values: Mapping[str, float], mode: str, gains: StickGains | None
    ) -> StickCurves:
        """Return the curves of lean, yaw rate and climb rate in ALTCTL and STABILIZED."""
        return px4_curves(values, mode, gains)

    def hover_thrust(self, values: Mapping[str, float]) -> float | None:
        """Return MPC_THR_HOVER."""
        return values.get("MPC_THR_HOVER")

    def hand_per_s(self, values: Mapping[str, float]) -> float:
        """See `Profile`. 1.18 has MAN_OVERRIDE_SPD (negative: off).

        Before, COM_RC_STICK_OV is a percentage, on by bit 0 of COM_RC_OVERRIDE.
        """
        if (hand_per_s := values.get("MAN_OVERRIDE_SPD")) is None:
            is_on = int(values.get("COM_RC_OVERRIDE", 1)) & 1
            hand_per_s = values.get("COM_RC_STICK_OV", 100.0 * _SLOWEST_HAND_PER_S) / 100.0
            hand_per_s = hand_per_s if is_on else -1.0
        return hand_per_s if hand_per_s > 0.0 else math.inf

    def climb_limits(self, values: Mapping[str, float]) -> tuple[float, float]:
        """Return MPC_Z_VEL_MAX_UP and _DN; below 0 they would reverse the motion."""
        climb_mps = values.get("MPC_Z_VEL_MAX_UP", 3.0)
        return max(climb_mps, 0.0), max(values.get("MPC_Z_VEL_MAX_DN", 1.5), 0.0)

    def takeoff(self, height_m: float, amsl_m: float | None) -> CommandRequest | None:
        """Return NAV_TAKEOFF, which enters AUTO.TAKEOFF, with a height above mean sea level.

        Position and heading are NaN: the vehicle keeps its own.
        """
        if amsl_m is None:
            return None
        here = math.nan
        return CommandRequest(
            dialect.MAV_CMD_NAV_TAKEOFF, (here, 0, 0, here, here, here, amsl_m + height_m)
        )


def _stick_advice(values: Mapping[str, float]) -> Iterator[ParamNote]:
    """Yield settings that weaken or change a stick in one mode."""
    full_deg, limit_deg = values.get("MPC_MAN_TILT_MAX", 0.0), values.get("MPC_TILTMAX_AIR")
    if limit_deg is not None and limit_deg < full_deg:
        yield ParamNote(
            ("MPC_TILTMAX_AIR",),
            f"MPC_TILTMAX_AIR is {limit_deg:g}: in ALTCTL it leans no further, and full stick is "
            f"{full_deg:g} deg (MPC_MAN_TILT_MAX)",
            f"--set MPC_TILTMAX_AIR={full_deg:g}",
        )
    if values.get("MPC_THR_CURVE") == _NO_RESCALE:
        yield ParamNote(
            ("MPC_THR_CURVE",),
            "MPC_THR_CURVE is 1: in STABILIZED the middle of the throttle is half of full thrust, "
            "and not hover thrust",
            "--set MPC_THR_CURVE=0",
        )


PX4 = Px4()
