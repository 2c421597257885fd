"""Parameters that the simulated firmware reads, with ArduCopter's names and SITL defaults.

The code uses the names of the measured firmware, a development version of 4.7, which has the system
ids of 4.7 and the units of 4.6. On the wire the names are those of
`VehicleConfig.ardupilot_release`. Values are float32, as on the wire (PARAM_VALUE carries REAL32).
Values that vary between vehicles come from the conditions; their nominal attitude gains and rate
limits are this vehicle's tuning, not the firmware's defaults.
"""

from sitl.vehicle.conditions import Conditions
from sitl.vehicle.config import DEFAULT_VEHICLE, VehicleConfig
from sitl.vehicle.firmware import Params, float32

RC_CHANNELS_WITH_PARAMS = 8
DEFAULT_RATE_P = float32(0.135)  # gain from body rates to torque, roll and pitch
_FIXED = {
    "ATC_ACCEL_Y_MAX": 27000.0,  # cdeg/s^2, in GUIDED only; 0: no limit
    "ATC_ANGLE_BOOST": 1.0,  # more thrust in a lean
    "ATC_RATE_Y_MAX": 0.0,  # deg/s, in GUIDED only; 0: no limit
    "DISARM_DELAY": 10.0,  # s
    "FLTMODE_CH": 5.0,  # stored only: no switch changes the mode
    "FS_OPTIONS": 16.0,  # bit 2: GUIDED continues; 3: a landing
    "FS_THR_ENABLE": 1.0,  # 0 off, 1 RTL, 3 LAND, 7 BRAKE
    "FS_THR_VALUE": 975.0,  # us; stored only
    "GUID_OPTIONS": 0.0,  # bit 3: SET_ATTITUDE_TARGET.thrust is thrust, not a climb rate
    "GUID_TIMEOUT": 3.0,  # s until a setpoint is stale
    "LAND_SPEED": 50.0,  # cm/s
    "MAV_GCS_SYSID": 255.0,
    "MAV_GCS_SYSID_HI": 0.0,
    "MAV_OPTIONS": 0.0,  # bit 0: listen to the GCS only
    "MAV_SYSID": 1.0,
    "MOT_THST_HOVER": 0.39,
    "RCMAP_PITCH": 2.0,
    "RCMAP_ROLL": 1.0,
    "RCMAP_THROTTLE": 3.0,
    "RCMAP_YAW": 4.0,
    "RC_FS_TIMEOUT": 1.0,  # s
    "RC_OPTIONS": 32.0,  # bit 0 ignore receiver, 1 ignore overrides
    "RC_OVERRIDE_TIME": 3.0,  # s; 0 refuses overrides, < 0 never expires
    "RTL_ALT": 1500.0,  # cm
    "SIMPLE": 0.0,  # stored only: the sticks keep the vehicle's axes
    "SUPER_SIMPLE": 0.0,
    "WPNAV_ACCEL_Z": 100.0,  # cm/s^2
    "WPNAV_SPEED_DN": 150.0,  # cm/s
    "WPNAV_SPEED_UP": 250.0,  # cm/s
}
_RC_CHANNEL = {"MAX": 2000.0, "MIN": 1000.0, "OPTION": 0.0, "REVERSED": 0.0, "TRIM": 1500.0}

_NAMES_4_6 = {
    "MAV_GCS_SYSID": "SYSID_MYGCS",
    "MAV_OPTIONS": "SYSID_ENFORCE",  # corresponds to bit 0
    "MAV_SYSID": "SYSID_THISMAV",
}


def _varied(conditions: Conditions) -> dict[str, float]:
    roll_gain, pitch_gain, yaw_gain = conditions.angle_gains_per_s
    return {
        "ANGLE_MAX": conditions.angle_max_cdeg,
        "ATC_ACCEL_P_MAX": conditions.lean_accel_max_cdegps2,  # 0: no limit
        "ATC_ACCEL_R_MAX": conditions.lean_accel_max_cdegps2,
        "ATC_ANG_PIT_P": pitch_gain,  # 1/s
        "ATC_ANG_RLL_P": roll_gain,
        "ATC_ANG_YAW_P": yaw_gain,
        "ATC_INPUT_TC": conditions.input_time_s,  # s
        "ATC_RAT_PIT_P": DEFAULT_RATE_P * conditions.rate_gain_factor,
        "ATC_RAT_RLL_P": DEFAULT_RATE_P * conditions.rate_gain_factor,
        "ATC_RATE_P_MAX": conditions.lean_rate_max_degps,  # deg/s; 0: no limit
        "ATC_RATE_R_MAX": conditions.lean_rate_max_degps,
        "PILOT_ACCEL_Z": conditions.pilot_accel_z_cmps2,
        "PILOT_SPEED_DN": conditions.pilot_speed_down_cmps,  # 0: equal to up
        "PILOT_SPEED_UP": conditions.pilot_speed_up_cmps,
        "PILOT_Y_EXPO": conditions.pilot_yaw_expo,
        "PILOT_Y_RATE": conditions.pilot_yaw_rate_degps,
        "THR_DZ": conditions.throttle_dead_zone_permille,  # of the stick, each side of the middle
    }


class ArduPilotParams(Params):
    """ArduPilot's parameters, on the wire by the names of the release."""

    def __init__(self, config: VehicleConfig = DEFAULT_VEHICLE) -> None:
        values = _FIXED | _varied(config.conditions)
        dead_zones_us = config.conditions.rc_dead_zones_us
        for index in range(RC_CHANNELS_WITH_PARAMS):
            dead_zone_us = dead_zones_us[index] if index < len(dead_zones_us) else 0.0
            channel = {**_RC_CHANNEL, "DZ": dead_zone_us}
            values |= {f"RC{index + 1}_{name}": value for name, value in channel.items()}
        is_old = config.ardupilot_release == "4.6"
        if is_old:
            del values["MAV_GCS_SYSID_HI"]
        super().__init__(values, renamed=_NAMES_4_6 if is_old else {})
