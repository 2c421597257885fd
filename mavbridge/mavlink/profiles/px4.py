"""Profile of PX4's multicopters, measured on 1.18.

Formulas of sticks: PX4's ``Sticks``, ``StickTiltXY``, ``StickYaw``, ``FlightTaskManualAltitude``
and, for STABILIZED, ``mc_att_control``. The tests compare them with leans and rates measured on the
firmware.
"""

import math
from collections.abc import Iterator, Mapping
from typing import ClassVar, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.vehicle import ModeRoles, Output, StickGains
from mavbridge.mavlink.codec.messages import CommandRequest
from mavbridge.mavlink.profiles.profile import (
    EventMeaning,
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
from mavbridge.mavlink.profiles.sticks import (
    IDENTITY,
    MAX_DEAD_ZONE,
    Axis,
    Bend,
    Half,
    Lean,
    StickCurves,
    curves_between,
    unusable,
)

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
_NO_MAVLINK_STICKS = {0: "RC only", 4: "sticks disabled"}
"""Values of COM_RC_IN_MODE that exclude MAVLink's sticks."""
_RECEIVER_FIRST, _FIRST_COME = (5, 7), (2, 3)
"""Values of COM_RC_IN_MODE that prefer a receiver's sticks, and that keep the first source's."""
_NO_RECEIVER = (1, 4)
"""Values of COM_RC_IN_MODE that exclude a receiver's sticks: only MAVLink's, or none."""
_MAVLINK_FIRST = (6, 8)
"""Values of COM_RC_IN_MODE that prefer MAVLink's sticks, and without them take a receiver's."""
_NO_RESCALE = 1
"""Value of MPC_THR_CURVE."""
_FATAL_ACTIONS = {5: "terminate the flight", 6: "disarm"}
"""Values of NAV_RCL_ACT."""
_FATAL_OFFBOARD_ACTIONS = {6: "terminate the flight", 7: "disarm"}
"""Values of COM_OBL_RC_ACT."""
_EXCEPT_HOLD, _EXCEPT_OFFBOARD = 2, 4
"""Bits of COM_RCL_EXCEPT: modes in which the loss of sticks is no failsafe."""
_SLOWEST_HAND_PER_S = 0.05
"""Default if neither parameter was read: the minimum of COM_RC_STICK_OV, 5 %."""

_MAIN_MODES = {
    **dict(
        enumerate(("MANUAL", "ALTCTL", "POSCTL", "AUTO", "ACRO", "OFFBOARD", "STABILIZED"), start=1)
    ),
    10: "TERMINATION",
    11: "ALTITUDE_CRUISE",
}
_AUTO, _AUTO_MODES = 4, enumerate(("TAKEOFF", "LOITER", "MISSION", "RTL", "LAND"), start=2)
_COMMANDS = {
    name: (number, 0)
    for number, name in _MAIN_MODES.items()
    if name not in ("AUTO", "TERMINATION")  # without a sub-mode, and never
} | {f"AUTO.{name}": (_AUTO, sub) for sub, name in _AUTO_MODES}
_MODES = ModeTable(
    {main << 16: name for main, name in _MAIN_MODES.items()}
    | {3 << 16 | 1 << 24: "POSCTL.ORBIT"}
    | {main << 16 | sub << 24: name for name, (main, sub) in _COMMANDS.items()},
    _COMMANDS,
    main_mask=0xFF << 16,
    roles=ModeRoles(
        names=tuple(_COMMANDS),
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
    "commander_rc_lost": EventMeaning(is_stick_loss=True, text="manual control lost"),
    "commander_rc_regained": EventMeaning(text="manual control regained"),
}


EXPO = 0.6
"""Expo of the yaw and climb sticks: cubic fraction; the default of older versions too."""
_LEAN_MODES = ("ALTCTL", "STABILIZED")
"""Modes in which sticks are a lean and a yaw rate."""
_CLIMB_MODE = "ALTCTL"
_MAX_TILT_DEG = 89.0
_LEAST_EXPO = 1e-3
"""Expo below which the curve counts as a straight line."""
_LEAST_LINEAR = 1e-9
"""Linear fraction below which the curve counts as a cube."""


class CubicExpo(NamedTuple):
    """Expo curve (1 - e) x + e x^3."""

    expo: float

    def bent(self, share: float) -> float:
        """Return the fraction of the motion at this fraction of the stick."""
        return share * (1.0 - self.expo + self.expo * share * share)

    def straightened(self, share: float) -> float:
        """Return the fraction of the stick: the real root, by Cardano's hyperbolic formula."""
        linear = 1.0 - self.expo
        if linear < _LEAST_LINEAR:
            return math.cbrt(share)
        root = math.sqrt(linear / (3.0 * self.expo))
        return 2.0 * root * math.sinh(math.asinh(1.5 * share / (linear * root)) / 3.0)


class Px4(Profile):
    """PX4, as measured: sticks as MANUAL_CONTROL, setpoints in OFFBOARD."""

    name = "px4"
    modes = _MODES
    stick_output: ClassVar[Output] = "manual-control"
    refusal = "PX4 cannot release an RC_CHANNELS_OVERRIDE: use --output manual-control"
    heartbeat_type = dialect.MAV_TYPE_GCS
    """PX4 sends STATUSTEXT only on links with a ground station."""
    is_bytewise = True
    has_rc_channels_always = False
    events: ClassVar[Mapping[int, EventMeaning]] = {
        event_id(name): meaning for name, meaning in _EVENTS.items()
    }
    sends_invalid_estimates = True
    shows_rates = True
    target_hz = 100.0
    stick_echo = StreamGroup(("MANUAL_CONTROL",), FAST_HZ, least_hz=0.0)
    """Shows the selected sticks at the sender's rate."""
    hover_param = "MPC_THR_HOVER"
    params = (
        *("COM_RC_IN_MODE", "COM_RC_LOSS_T", "COM_RCL_EXCEPT", "NAV_RCL_ACT", "COM_FAIL_ACT_T"),
        *("COM_OF_LOSS_T", "COM_OBL_RC_ACT", "COM_DISARM_PRFLT", "COM_DISARM_LAND"),
        *("MAN_OVERRIDE_SPD", "NAV_DLL_ACT", "MPC_THR_HOVER", "COM_RC_OVERRIDE", "COM_RC_STICK_OV"),
        *("MPC_MAN_TILT_MAX", "MPC_MAN_Y_MAX", "MPC_YAW_EXPO", "MPC_Z_MAN_EXPO"),
        *("MPC_Z_VEL_MAX_UP", "MPC_Z_VEL_MAX_DN", "MAN_DEADZONE", "MPC_HOLD_DZ"),
        *("MAN_KILL_GEST_T", "MPC_TILTMAX_AIR", "MC_YAWRATE_MAX", "MPC_THR_CURVE"),
    )

    def streams(self, *, state_hz: float, pilot_hz: float | None = None) -> tuple[StreamGroup, ...]:
        """See `Profile`. RC_CHANNELS needs a receiver, GLOBAL_POSITION_INT a position.

        The pilot's sticks come in MANUAL_CONTROL, requested by ``echo`` at their own rate.
        """
        fast_hz = state_hz if state_hz <= _UNEVEN_HZ else FAST_HZ
        slow_hz = min(state_hz, POSITION_CEILING_HZ)
        return (
            StreamGroup(("ATTITUDE_QUATERNION", "ATTITUDE"), fast_hz, is_needed=True),
            StreamGroup(("LOCAL_POSITION_NED",), slow_hz, is_needed=True),
            StreamGroup(("HIGHRES_IMU", "SCALED_IMU"), fast_hz, is_needed=True),
            StreamGroup(
                ("CURRENT_MODE",),
                CURRENT_MODE_HZ,
                least_hz=1.0,
                without="PX4 before 1.15, or MAVLink 1; a takeover shows in HEARTBEAT, which is "
                "asked for 20 times a second",
                stand_in="HEARTBEAT",
            ),
            StreamGroup(("RC_CHANNELS",), pilot_hz or RC_CHANNELS_HZ, least_hz=0.0),
            *condition_streams("ESTIMATOR_STATUS"),
            StreamGroup(("GLOBAL_POSITION_INT",), 2.0, least_hz=0.0),
        )

    def traits(self, values: Mapping[str, float]) -> Traits:
        """See `Profile`. Below 0, limits of climb and descent would reverse the motion."""
        source = values.get("COM_RC_IN_MODE")
        limits = values.get("MPC_Z_VEL_MAX_UP", 3.0), values.get("MPC_Z_VEL_MAX_DN", 1.5)
        return Traits(
            ignores_receiver=source in _NO_RECEIVER,
            falls_back=source in _MAVLINK_FIRST,
            hand_per_s=_hand_per_s(values),
            climb_limits_mps=(max(limits[0], 0.0), max(limits[1], 0.0)),
        )

    def notes(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """See `Profile`."""
        if context.output == "manual-control":
            yield from _stick_notes(values, context)
            yield from _end_notes(values, "COM_RC_LOSS_T", "NAV_RCL_ACT", _FATAL_ACTIONS)
            yield from _exception_notes(values, _EXCEPT_HOLD, "AUTO")
        elif context.output is not None:
            yield from _end_notes(
                values, "COM_OF_LOSS_T", "COM_OBL_RC_ACT", _FATAL_OFFBOARD_ACTIONS
            )
            yield from _exception_notes(values, _EXCEPT_OFFBOARD, "OFFBOARD")
            if values.get("COM_OBL_RC_ACT") == 0:
                effect = ": when setpoints end it enters POSCTL; without sticks it may RTL or land"
                yield ParamNote.of("hint", "COM_OBL_RC_ACT", 0, effect, 4, " (land), or 5 (hold)")

    def stick_curves(
        self, values: Mapping[str, float], mode: str, gains: StickGains | None
    ) -> StickCurves:
        """See `Profile`.

        ALTCTL maps all sticks, STABILIZED all but the throttle, which is thrust there. In other
        modes sticks have meanings that ``gains`` does not cover: a speed in POSCTL, a body rate in
        ACRO.
        """
        if gains is None or mode not in _LEAN_MODES:
            return IDENTITY
        dead_zone = "MPC_HOLD_DZ" if "MPC_HOLD_DZ" in values else "MAN_DEADZONE"
        positive = ("MPC_MAN_TILT_MAX", "MPC_MAN_Y_MAX", "MPC_Z_VEL_MAX_UP", "MPC_Z_VEL_MAX_DN")
        needed = (*positive, dead_zone)
        if (nothing := unusable(values, needed=needed, positive=positive)) is not None:
            return nothing
        start = min(max(values[dead_zone], 0.0), MAX_DEAD_ZONE)
        climb = _expo(values, "MPC_Z_MAN_EXPO")

        def half(parameter: str, bend: Bend | None) -> Half:
            return Half(values[parameter], start, bend=bend, parameter=parameter)

        throttle = Axis(half("MPC_Z_VEL_MAX_UP", climb), half("MPC_Z_VEL_MAX_DN", climb))
        return curves_between(
            gains,
            throttle=throttle if mode == _CLIMB_MODE else None,
            yaw=Axis.even(half("MPC_MAN_Y_MAX", _expo(values, "MPC_YAW_EXPO"))),
            lean=_lean(values["MPC_MAN_TILT_MAX"], is_tangent=mode == _CLIMB_MODE),
        )

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


def _hand_per_s(values: Mapping[str, float]) -> float:
    """Return the speed by MAN_OVERRIDE_SPD of 1.18 (negative: off).

    Before, COM_RC_STICK_OV is a percentage, on by bit 0 of COM_RC_OVERRIDE.
    """
    if (hand_per_s := values.get("MAN_OVERRIDE_SPD")) is None:
        is_on = int(values.get("COM_RC_OVERRIDE", 1)) & 1
        hand_per_s = values.get("COM_RC_STICK_OV", 100.0 * _SLOWEST_HAND_PER_S) / 100.0
        hand_per_s = hand_per_s if is_on else -1.0
    return hand_per_s if hand_per_s > 0.0 else math.inf


def _expo(values: Mapping[str, float], name: str) -> Bend | None:
    expo = min(max(values.get(name, EXPO), 0.0), 1.0)
    return CubicExpo(expo) if expo >= _LEAST_EXPO else None


def _lean(tilt_deg: float, *, is_tangent: bool) -> Lean:
    """Return the lean: no dead zone; an acceleration in ALTCTL, a tilt in STABILIZED."""
    tilt_deg = min(tilt_deg, _MAX_TILT_DEG)
    full = math.tan(math.radians(tilt_deg)) if is_tangent else tilt_deg
    axis = Axis.even(Half(full))
    return Lean(axis, axis, full, is_tangent, "MPC_MAN_TILT_MAX")


def _stick_notes(values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
    """Yield what refuses, weakens or changes sticks, and gestures a policy might make."""
    version = context.version
    # 1.13 showed it as it was sent; a build without tags is 0.0.0.
    if version and [1, 14] <= [int(part) for part in version.split(".")] < [1, 16]:
        effect = "shows the throttle as -1000 to 1000, so that our sticks cannot be checked"
        cure = "update it to 1.16 or later, or fly by setpoints"
        yield ParamNote("obstacle", (), f"PX4 {version} {effect}: {cure}")
    if (time_s := values.get("MAN_KILL_GEST_T", -1.0)) >= 0:
        effect = ": both sticks held down and outwards stop the motors, in flight too"
        yield ParamNote.of("obstacle", "MAN_KILL_GEST_T", time_s, effect, -1)
    yield ParamNote("wanted", ("COM_RC_IN_MODE",), "1; with a receiver 6 or 8")
    mode = values.get("COM_RC_IN_MODE", 1.0)
    or_else = " (MAVLink only), or 6 with a receiver (MAVLink first; PX4 1.17 and later)"
    if mode in _NO_MAVLINK_STICKS:
        why = f" ({_NO_MAVLINK_STICKS[int(mode)]})"
        yield ParamNote.of("obstacle", "COM_RC_IN_MODE", mode, why, 1, or_else)
    if mode in _RECEIVER_FIRST and context.has_receiver:
        why = " (the receiver first)"
        yield ParamNote.of("obstacle", "COM_RC_IN_MODE", mode, why, 6, " (MAVLink first)")
    if mode in _FIRST_COME and context.has_receiver:
        effect = ": PX4 ignores our sticks if the receiver was there first"
        yield ParamNote.of("advice", "COM_RC_IN_MODE", mode, effect, 1, or_else)
    if mode in _MAVLINK_FIRST and context.has_receiver:
        effect = ": while our sticks flow PX4 ignores all switches of the transmitter: take over "
        effect += "by --engage-channel; they count 0.6 s later, once moved"
        yield ParamNote.of("advice", "COM_RC_IN_MODE", mode, effect)
    yield from clipped_note(values, "MPC_TILTMAX_AIR", "MPC_MAN_TILT_MAX")
    yield from clipped_note(values, "MC_YAWRATE_MAX", "MPC_MAN_Y_MAX")
    if values.get("MPC_THR_CURVE") == _NO_RESCALE:
        effect = ": in STABILIZED the middle of the throttle is half thrust, not hover thrust"
        yield ParamNote.of("advice", "MPC_THR_CURVE", _NO_RESCALE, effect, 0)
    yield ParamNote("wanted", ("COM_DISARM_PRFLT",), "longer than it takes to lift off")


def _end_notes(
    values: Mapping[str, float], time: str, action: str, fatal: Mapping[int, str]
) -> Iterator[ParamNote]:
    """Yield unexpected effects of the end of our packets, by two parameters."""
    does, is_setpoint = "go on with the last it was told", time == "COM_OF_LOSS_T"
    yield from timeout_notes(values, time, does, is_setpoint=is_setpoint)
    end = "4 or 5 (land, hold)" if is_setpoint else "1, 2 or 3 (hold, return, land)"
    yield ParamNote("wanted", (action,), end)
    if (value := values.get(action, 0.0)) in fatal:
        effect = f": it would {fatal[int(value)]} if our packets stopped"
        yield ParamNote.of("advice", action, value, effect)


def _exception_notes(values: Mapping[str, float], bit: int, mode: str) -> Iterator[ParamNote]:
    """Yield a hint if lost sticks are a failsafe in these modes too."""
    yield ParamNote("wanted", ("COM_RCL_EXCEPT",), f"with {bit} in it")
    exceptions = values.get("COM_RCL_EXCEPT", bit)
    if not int(exceptions) & bit:
        effect = f": sticks seen at arming that end later are a failsafe in {mode} modes too"
        yield ParamNote.of("hint", "COM_RCL_EXCEPT", exceptions, effect, int(exceptions) | bit)


PX4 = Px4()
