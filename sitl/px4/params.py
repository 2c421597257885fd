"""Parameters that the simulated firmware reads or a bridge requests, with PX4's SIH defaults.

PX4 stores INT32 and float.
"""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from sitl.vehicle.conditions import NOMINAL, Conditions
from sitl.vehicle.config import DEFAULT_VEHICLE, Px4Release, VehicleConfig
from sitl.vehicle.firmware import Params, float32

_INTEGERS: Mapping[str, int] = MappingProxyType(
    {
        "COM_RC_OVERRIDE": 1,  # bit 0: sticks take over in AUTO modes, bit 1: in OFFBOARD
        "COM_OBL_RC_ACT": 0,  # 0 position, 1 altitude, 2 stabilized, 3 RTL, 4 land, 5 hold
        "COM_RCL_EXCEPT": 0,  # bit 1 hold, 2 offboard: lost sticks are no failsafe
        "COM_RC_IN_MODE": 1,  # source of sticks: see `sitl.px4.sticks`
        "NAV_DLL_ACT": 0,  # a lost ground station does nothing
        "NAV_RCL_ACT": 2,  # lost sticks: 1 hold, 2 RTL, 3 land, 5 terminate, 6 disarm
        "RC_MAP_PITCH": 0,  # channel from 1; 0: not mapped
        "SYS_AUTOSTART": 10040,  # SIH quadrotor
    }
    | {"MAN_ARM_GESTURE": 1, "MAV_COMP_ID": 1, "MAV_SYS_ID": 1}
    | {"MAV_TYPE": 2, "MPC_THR_CURVE": 0, "RC_MAP_ROLL": 0, "RC_MAP_THROTTLE": 0, "RC_MAP_YAW": 0}
)
_FLOATS: Mapping[str, float] = MappingProxyType(
    {
        "COM_DISARM_LAND": 2.0,  # s
        "COM_DISARM_PRFLT": 10.0,  # s
        "COM_FAIL_ACT_T": 5.0,  # s
        "COM_OF_LOSS_T": 1.0,  # s
        "COM_RC_LOSS_T": 0.5,  # s
        "COM_RC_STICK_OV": 30.0,  # % of stick travel per second
        "COM_SPOOLUP_TIME": 1.0,  # s
        "MAN_DEADZONE": 0.1,  # of the stick, to each side of the middle
        "MAN_OVERRIDE_SPD": 1.0,  # full sticks per second; -1: off
        "MC_PITCHRATE_MAX": 220.0,  # deg/s
        "MC_PITCH_P": 4.0,  # 1/s
        "MIS_TAKEOFF_ALT": 2.5,  # m
        "MPC_ACC_DOWN_MAX": 3.0,  # m/s^2
        "MPC_JERK_AUTO": 4.0,  # m/s^3
        "MPC_LAND_ALT1": 10.0,  # m: slower descent below
        "MPC_LAND_ALT2": 5.0,  # m: descent at MPC_LAND_SPEED below
        "MPC_LAND_SPEED": 0.7,  # m/s
        "MPC_MAN_TILT_MAX": 35.0,  # deg
        "MPC_MAN_Y_MAX": 150.0,  # deg/s
        "MPC_MAN_Y_TAU": 0.08,  # s
        "MPC_TILTMAX_AIR": 45.0,  # deg
        "MPC_TKO_RAMP_T": 3.0,  # s
        "MPC_TKO_SPEED": 1.5,  # m/s
    }
    | {"MAN_KILL_GEST_T": -1.0}
    | {"MC_PITCHRATE_P": 0.15, "MC_ROLLRATE_MAX": 220.0, "MC_ROLLRATE_P": 0.15, "MC_ROLL_P": 4.0}
    | {"MC_YAWRATE_MAX": 200.0, "MC_YAW_P": 2.8, "MPC_ACC_HOR": 3.0, "MPC_ACC_UP_MAX": 4.0}
    | {"MPC_JERK_MAX": 8.0, "MPC_MANTHR_MIN": 0.08, "MPC_THR_HOVER": 0.5, "MPC_THR_MAX": 1.0}
    | {"MPC_THR_MIN": 0.12, "MPC_VEL_MANUAL": 10.0, "MPC_XY_CRUISE": 5.0, "MPC_XY_P": 0.95}
    | {"MPC_XY_TRAJ_P": 0.5, "MPC_XY_VEL_D_ACC": 0.2, "MPC_XY_VEL_I_ACC": 0.4}
    | {"MPC_XY_VEL_MAX": 12.0, "MPC_XY_VEL_P_ACC": 1.8, "MPC_Z_VEL_MAX_DN": 1.5}
    | {"MPC_Z_VEL_MAX_UP": 3.0, "MPC_Z_V_AUTO_DN": 1.5, "MPC_Z_V_AUTO_UP": 3.0}
    | {"RTL_MIN_DIST": 10.0, "RTL_RETURN_ALT": 30.0}
)
_ABSENT: Mapping[Px4Release, tuple[str, ...]] = {
    "1.17": ("MAN_OVERRIDE_SPD",),
    "1.18": ("COM_RC_OVERRIDE", "COM_RC_STICK_OV"),
}
DEFAULT_RATE_P = float32(_FLOATS["MC_ROLLRATE_P"])


def _varied(conditions: Conditions) -> dict[str, float]:
    """Return the varying settings: PX4's defaults, scaled by the same factors as ArduPilot's."""
    down_cmps = conditions.pilot_speed_down_cmps or conditions.pilot_speed_up_cmps
    roll_gain, pitch_gain, yaw_gain = np.divide(
        conditions.angle_gains_per_s, NOMINAL.angle_gains_per_s
    ).tolist()
    climb_accel = conditions.pilot_accel_z_cmps2 / NOMINAL.pilot_accel_z_cmps2
    factors = {
        "MC_PITCHRATE_P": conditions.rate_gain_factor,
        "MC_PITCH_P": pitch_gain,
        "MC_ROLLRATE_P": conditions.rate_gain_factor,
        "MC_ROLL_P": roll_gain,
        "MC_YAW_P": yaw_gain,
        "MPC_ACC_DOWN_MAX": climb_accel,
        "MPC_ACC_UP_MAX": climb_accel,
        "MPC_MAN_TILT_MAX": conditions.angle_max_cdeg / NOMINAL.angle_max_cdeg,
        "MPC_MAN_Y_MAX": conditions.pilot_yaw_rate_degps / NOMINAL.pilot_yaw_rate_degps,
        "MPC_MAN_Y_TAU": conditions.input_time_s / NOMINAL.input_time_s,
        "MPC_Z_VEL_MAX_DN": down_cmps / NOMINAL.pilot_speed_up_cmps,
        "MPC_Z_VEL_MAX_UP": conditions.pilot_speed_up_cmps / NOMINAL.pilot_speed_up_cmps,
    }
    return {name: factor * _FLOATS[name] for name, factor in factors.items()}


class Px4Params(Params):
    """PX4's parameters of one release."""

    def __init__(self, config: VehicleConfig = DEFAULT_VEHICLE) -> None:
        """Set the release's defaults; with a receiver, map four channels in the usual order."""
        values: dict[str, float] = {**_INTEGERS, **_FLOATS, **_varied(config.conditions)}
        for name in _ABSENT[config.px4_release]:
            del values[name]
        if config.receiver_us is not None:
            values |= {"RC_MAP_ROLL": 1, "RC_MAP_PITCH": 2, "RC_MAP_THROTTLE": 3, "RC_MAP_YAW": 4}
        super().__init__(values, _INTEGERS)

    @property
    def dead_zone(self) -> float:
        return min(self._values["MAN_DEADZONE"], 0.99)
