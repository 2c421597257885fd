"""What is checked before the motors may turn, with ArduCopter's words for each refusal."""

from sitl.vehicle import sticks as pilot
from sitl.vehicle.flight_modes import Mode
from sitl.vehicle.params import Params
from sitl.vehicle.rc import RcEngine
from sitl.vehicle.sticks import Sticks

_OPTION_SKIP_NEUTRAL_CHECK = 64


def prearm_refusal(
    rc: RcEngine, params: Params, *, estimator_ready: bool, radio_failsafe: bool
) -> str | None:
    """What keeps the vehicle from being ready to arm (SYS_STATUS PREARM_CHECK), or None."""
    if not estimator_ready:
        return "AHRS: EKF3 not started"
    if not rc.found:
        return "RC not found"
    if radio_failsafe:
        return "Radio failsafe on"
    throttle_us = rc.channels_us[rc.index_of("THROTTLE")]
    if params["FS_THR_ENABLE"] and throttle_us < params["FS_THR_VALUE"]:
        return "Throttle below failsafe"
    return None


def stick_refusal(mode: Mode, sticks: Sticks, rc: RcEngine, params: Params) -> str | None:
    """What mode and sticks have against arming a vehicle that is ready, or None."""
    if not mode.piloted:
        return f"{mode.name} mode not armable"
    if pilot.climb_rate_mps(sticks, params) > 0.0 or (mode.manual_throttle and sticks.throttle > 0):
        return "Throttle too high"
    if params.integer("RC_OPTIONS") & _OPTION_SKIP_NEUTRAL_CHECK:
        return None
    for axis, value in (("Roll", sticks.roll), ("Pitch", sticks.pitch), ("Yaw", sticks.yaw)):
        if value != 0.0:
            return f"{axis} (RC{rc.index_of(axis.upper()) + 1}) is not neutral"
    return None
