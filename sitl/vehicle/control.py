"""Height to thrust, thrust and angular acceleration to motors: what every firmware here shares."""

from sitl.rotation import Vec3
from sitl.vehicle.dynamics import (
    GRAVITY_MPS2,
    INERTIA_KGM2,
    MOTOR_ARM_M,
    QUAD,
    YAW_TORQUE_PER_THRUST_M,
    Airframe,
    BodyState,
)

SPIN_MIN = 0.05  # lowest thrust of an armed, flying motor


def clamp(value: float, limit: float) -> float:
    """The value within +-limit."""
    return max(-limit, min(limit, value))


class HeightController:
    """Climb rate demand to vertical acceleration; holds the height where the demand is zero."""

    HEIGHT_GAIN_PER_S = 1.0
    CLIMB_GAIN_PER_S = 5.0
    INTEGRAL_GAIN_PER_S2 = 2.0
    MAX_INTEGRAL_MPS2 = 3.0
    MAX_HEIGHT_ERROR_M = 2.0
    MAX_ACCEL_MPS2 = 0.7 * GRAVITY_MPS2

    def __init__(self) -> None:
        self._height_m = self._climb_mps = self._integral_mps2 = 0.0

    def reset(self, body: BodyState) -> None:
        """Start from the present height and climb rate."""
        self._height_m = -body.position_ned_m[2]
        self._climb_mps = -body.velocity_ned_mps[2]
        self._integral_mps2 = 0.0

    def update(
        self, body: BodyState, climb_mps: float, max_accel_mps2: float, dt_s: float
    ) -> float:
        """Upward acceleration in m/s^2; the demand itself changes by no more than the limit."""
        height, climb = -body.position_ned_m[2], -body.velocity_ned_mps[2]
        self._climb_mps += clamp(climb_mps - self._climb_mps, max_accel_mps2 * dt_s)
        self._height_m += self._climb_mps * dt_s
        self._height_m = height + clamp(self._height_m - height, self.MAX_HEIGHT_ERROR_M)
        wanted = self._climb_mps + self.HEIGHT_GAIN_PER_S * (self._height_m - height)
        error = wanted - climb
        self._integral_mps2 = clamp(
            self._integral_mps2 + self.INTEGRAL_GAIN_PER_S2 * error * dt_s, self.MAX_INTEGRAL_MPS2
        )
        accel = self.CLIMB_GAIN_PER_S * error + self._integral_mps2
        return clamp(accel, self.MAX_ACCEL_MPS2)


def thrust_for(accel_up_mps2: float, cos_tilt: float, hover: float) -> float:
    """Collective in [0, 1] for a vertical acceleration; the tilt boost ends at 60 degrees."""
    return max(0.0, min(1.0, hover * (1.0 + accel_up_mps2 / GRAVITY_MPS2) / max(cos_tilt, 0.5)))


_ROLL_SIGN = (-1.0, 1.0, 1.0, -1.0)
_PITCH_SIGN = (1.0, -1.0, 1.0, -1.0)
_YAW_SIGN = (1.0, 1.0, -1.0, -1.0)


def mix(
    collective: float, angular_accel_radps2: Vec3, airframe: Airframe = QUAD
) -> tuple[float, ...]:
    """Four motor commands in [SPIN_MIN, 1]: attitude first, then thrust, yaw with what is left."""
    ix, iy, iz = INERTIA_KGM2
    ax, ay, az = angular_accel_radps2
    per_arm = 4.0 * MOTOR_ARM_M * airframe.max_motor_thrust_n
    roll = clamp(ax * ix / per_arm, 0.25)
    pitch = clamp(ay * iy / per_arm, 0.25)
    yaw_room = max(0.05, 0.45 - abs(roll) - abs(pitch))
    yaw = clamp(az * iz / (4.0 * YAW_TORQUE_PER_THRUST_M * airframe.max_motor_thrust_n), yaw_room)
    turns = tuple(
        r * roll + p * pitch + y * yaw
        for r, p, y in zip(_ROLL_SIGN, _PITCH_SIGN, _YAW_SIGN, strict=True)
    )
    collective = max(SPIN_MIN - min(turns), min(1.0 - max(turns), collective))
    return tuple(max(SPIN_MIN, min(1.0, collective + turn)) for turn in turns)
