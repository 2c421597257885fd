"""SET_ATTITUDE_TARGET and SET_POSITION_TARGET_LOCAL_NED: what is taken, and what brakes.

They are never answered, and ignored outside GUIDED and GUIDED_NOGPS. An invalid one makes GUIDED
brake and leaves GUIDED_NOGPS with its last setpoint, as measured on the firmware.
"""

import math

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.ardupilot.autopilot import Autopilot
from sitl.ardupilot.flight_modes import Mode
from sitl.ardupilot.guided import AttitudeSetpoint, VelocitySetpoint
from sitl.link.framing import Message
from sitl.rotation import from_euler, rotate, to_euler

MAX_NORM_ERROR = 1e-3  # of the squared length of a quaternion

_RATES_IGNORED = (
    mav.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE
    | mav.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
    | mav.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
)
_POSITION_IGNORED = (
    mav.POSITION_TARGET_TYPEMASK_X_IGNORE
    | mav.POSITION_TARGET_TYPEMASK_Y_IGNORE
    | mav.POSITION_TARGET_TYPEMASK_Z_IGNORE
)
_VELOCITY_IGNORED = (
    mav.POSITION_TARGET_TYPEMASK_VX_IGNORE
    | mav.POSITION_TARGET_TYPEMASK_VY_IGNORE
    | mav.POSITION_TARGET_TYPEMASK_VZ_IGNORE
)
_NED_AXES = (mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_LOCAL_OFFSET_NED)
_BODY_AXES = (mav.MAV_FRAME_BODY_NED, mav.MAV_FRAME_BODY_OFFSET_NED)


def set_attitude_target(message: Message, ap: Autopilot, now_ns: int) -> bool:
    """Act on a SET_ATTITUDE_TARGET; True if it is followed from now on."""
    if ap.guided is None:
        return False
    setpoint = _attitude_setpoint(message)
    if setpoint is not None:
        ap.guided.follow_attitude(setpoint, ap.sensed, now_ns)
    elif ap.mode is Mode.GUIDED:
        ap.guided.brake(ap.sensed)
    return setpoint is not None


def set_position_target(message: Message, ap: Autopilot, now_ns: int) -> bool:
    """Act on a SET_POSITION_TARGET_LOCAL_NED, which GUIDED_NOGPS ignores; as above."""
    if ap.guided is None or ap.mode is not Mode.GUIDED:
        return False
    setpoint = _velocity_setpoint(message, to_euler(ap.sensed.ned_from_body_wxyz)[2])
    if setpoint is None:
        ap.guided.brake(ap.sensed)
    else:
        ap.guided.follow_velocity(setpoint, ap.sensed, now_ns)
    return setpoint is not None


def _attitude_setpoint(message: Message) -> AttitudeSetpoint | None:
    mask = message.type_mask
    ignored_rates = mask & _RATES_IGNORED
    if mask & mav.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE:
        return None
    if ignored_rates not in (0, _RATES_IGNORED):
        return None
    attitude = None
    if not mask & mav.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE:
        w, x, y, z = message.q
        norm = w * w + x * x + y * y + z * z
        if not abs(norm - 1.0) <= MAX_NORM_ERROR:  # also not a number
            return None
        length = math.sqrt(norm)
        attitude = (w / length, x / length, y / length, z / length)
    rate = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
    return AttitudeSetpoint(attitude, (0.0, 0.0, 0.0) if ignored_rates else rate, message.thrust)


def _velocity_setpoint(message: Message, heading_rad: float) -> VelocitySetpoint | None:
    """The velocity in NED axes; accelerations and a heading in the message have no effect."""
    mask = message.type_mask
    if mask & _VELOCITY_IGNORED or mask & _POSITION_IGNORED != _POSITION_IGNORED:
        return None
    velocity_mps = (message.vx, message.vy, message.vz)
    if message.coordinate_frame in _BODY_AXES:
        velocity_mps = rotate(from_euler(0.0, 0.0, heading_rad), velocity_mps)
    elif message.coordinate_frame not in _NED_AXES:
        return None
    has_rate = not mask & mav.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
    return VelocitySetpoint(velocity_mps, message.yaw_rate if has_rate else 0.0)
