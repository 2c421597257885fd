"""Quadrotor physics: a MuJoCo free body with motor lag, drag and ground contact, wind, sensor
noise, and the controllers common to both firmwares.

MuJoCo works in north-west-up with a forward-left-up body; everything outside this module is NED and
FRD. Both differ by a half turn about x, so vectors and the vector part of quaternions flip y and z:
``_flip`` is the only conversion.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from sitl.vehicle.conditions import NOMINAL, Conditions
from sitl.vehicle.rotation import Quat, Vec3, cos_tilt, length, vec3

GRAVITY_MPS2 = 9.80665
INERTIA_KGM2: Vec3 = (0.012, 0.012, 0.022)
MOTOR_ARM_M = 0.12  # motors sit at (+-arm, +-arm): a 0.34 m diagonal wheelbase
MOTORS = ((1, -1), (-1, 1), (1, 1), (-1, -1))
"""Forward and left of each motor, in the order of ArduCopter's quad X. The first two turn
anticlockwise seen from above, so they push the nose to the right."""
YAW_TORQUE_PER_THRUST_M = 0.016
REST_HEIGHT_M = 0.06
VERTICAL_GUST_SHARE = 0.5
"""Vertical over horizontal gust strength; near the ground, air moves along the ground."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Airframe:
    """Physical constants of a quadrotor; the defaults are nominal."""

    mass_kg: float = 1.2
    max_motor_thrust_n: float = 7.54
    """Thrust for hover at 0.39 of full, ArduCopter's order of magnitude for a learned hover."""
    motor_lag_s: float = 0.028
    rotor_drag_nspm: float = 0.15
    """Linear drag of spinning rotors, about 0.1 1/s of mass at this size. Body drag is MuJoCo's
    quadratic model on the equivalent inertia box."""
    air_density_kgpm3: float = 1.225  # 0: rotor drag only
    step_ns: int = 1_250_000
    """Physics step; a firmware's control period is a whole number of them."""


QUAD = Airframe()

_BODY = 1  # after the world


def _model_xml(airframe: Airframe, conditions: Conditions) -> str:
    """Return the XML of the MuJoCo model; compiling it derives hidden values from the masses."""
    density = airframe.air_density_kgpm3 * conditions.drag_factor
    thrust_n = airframe.max_motor_thrust_n * conditions.thrust_factor
    motor_lag_s = airframe.motor_lag_s * conditions.motor_lag_factor
    inertia_kgm2 = [conditions.mass_factor * moment for moment in INERTIA_KGM2]
    sites, rotors = "", ""
    for forward, left in MOTORS:
        name, torque_m = f"{forward} {left}", forward * left * YAW_TORQUE_PER_THRUST_M
        sites += f'<site name="{name}" pos="{forward * MOTOR_ARM_M} {left * MOTOR_ARM_M} 0"/>'
        rotors += f'<general site="{name}" gear="0 0 1 0 0 {torque_m}"/>'
    return f"""
<mujoco>
  <option timestep="{airframe.step_ns / 1e9}" gravity="0 0 -{GRAVITY_MPS2}" density="{density}"
          integrator="implicitfast"/>
  <default>
    <general dyntype="filterexact" dynprm="{motor_lag_s}" gainprm="{thrust_n}"
             ctrlrange="0 1" ctrllimited="true"/>
  </default>
  <worldbody>
    <geom type="plane" pos="0 0 {-REST_HEIGHT_M}" size="0 0 1"/>
    <body>
      <freejoint/>
      <inertial pos="0 0 0" mass="{airframe.mass_kg * conditions.mass_factor}"
                diaginertia="{" ".join(map(str, inertia_kgm2))}"/>
      <geom type="sphere" size="0.02" pos="0.12 0.12 -0.04"/>
      <geom type="sphere" size="0.02" pos="0.12 -0.12 -0.04"/>
      <geom type="sphere" size="0.02" pos="-0.12 0.12 -0.04"/>
      <geom type="sphere" size="0.02" pos="-0.12 -0.12 -0.04"/>
      <geom type="box" size="0.14 0.14 0.03" pos="0 0 0.01"/>
      <site name="imu"/>
      {sites}
    </body>
  </worldbody>
  <actuator>{rotors}</actuator>
  <sensor><accelerometer site="imu"/></sensor>
</mujoco>
"""


class BodyState(NamedTuple):
    """State of the vehicle at one instant, in NED world and FRD body axes."""

    position_ned_m: Vec3
    ned_from_body_wxyz: Quat
    velocity_ned_mps: Vec3
    rate_body_radps: Vec3
    specific_force_body_mps2: Vec3  # accelerometer reading: (0, 0, -9.8) at rest
    touching: bool  # a part of the frame is on the ground


def _flip(v: Sequence[float]) -> Vec3:
    """Convert a vector between NWU and NED, or FLU and FRD, in either direction."""
    return (v[0], -v[1], -v[2])


class Quadrotor:
    """Physical model of one vehicle; it starts on the ground at the origin, heading north."""

    def __init__(self, conditions: Conditions = NOMINAL, airframe: Airframe = QUAD) -> None:
        self._model = mujoco.MjModel.from_xml_string(_model_xml(airframe, conditions))
        self._mass_kg = airframe.mass_kg * conditions.mass_factor
        self._max_motor_thrust_n = airframe.max_motor_thrust_n * conditions.thrust_factor
        rotor_drag_nspm = max(airframe.rotor_drag_nspm, conditions.min_rotor_drag_nspm)
        self._rotor_drag_nspm = rotor_drag_nspm * conditions.drag_factor
        self._model.dof_damping[:3] = self._rotor_drag_nspm
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self.body = self._capture()

    def launch(
        self, position_ned_m: Vec3, velocity_ned_mps: Vec3, ned_from_body_wxyz: Quat
    ) -> None:
        """Put the vehicle into the air, not rotating, with motors at hover thrust."""
        mujoco.mj_resetData(self._model, self._data)
        w, *vector = ned_from_body_wxyz
        self._data.qpos[:] = (*_flip(position_ned_m), w, *_flip(vector))
        self._data.qvel[:3] = _flip(velocity_ned_mps)
        tilt = max(0.5, cos_tilt(ned_from_body_wxyz))
        hover = self._mass_kg * GRAVITY_MPS2 / (4.0 * self._max_motor_thrust_n * tilt)
        self._data.act[:] = min(1.0, hover)
        mujoco.mj_forward(self._model, self._data)
        self.body = self._capture()

    def step(
        self,
        motor_commands: Sequence[float],
        substeps: int,
        wind_ned_mps: Vec3 = (0.0, 0.0, 0.0),
    ) -> None:
        """Run ``substeps`` physics steps with constant commands (0..1) and wind.

        MuJoCo's body drag includes the wind. Its damping, used as rotor drag, is relative to the
        ground, so the effect of moving air is added as a force.
        """
        self._data.ctrl[:] = motor_commands
        wind = _flip(wind_ned_mps)
        self._model.opt.wind[:] = wind
        self._data.xfrc_applied[_BODY, :3] = [self._rotor_drag_nspm * speed for speed in wind]
        mujoco.mj_step(self._model, self._data, nstep=substeps)
        self.body = self._capture()

    def _capture(self) -> BodyState:
        data = self._data
        qpos = data.qpos.tolist()
        qvel = data.qvel.tolist()
        return BodyState(
            position_ned_m=_flip(qpos[0:3]),
            ned_from_body_wxyz=(qpos[3], *_flip(qpos[4:7])),
            velocity_ned_mps=_flip(qvel[0:3]),
            rate_body_radps=_flip(qvel[3:6]),
            specific_force_body_mps2=_flip(data.sensordata.tolist()),
            touching=data.ncon > 0,
        )


class Wind:
    """Steady wind and gusts, one value per control step.

    Gusts are a first-order Gauss-Markov process per axis: the longitudinal Dryden spectrum seen by
    a vehicle that passes through the turbulence in ``gust_time_s`` (MIL-F-8785C).
    """

    def __init__(self, conditions: Conditions, step_s: float) -> None:
        self._random = np.random.Generator(np.random.PCG64((conditions.seed, 1)))
        self._mean = np.array(conditions.wind_ned_mps)
        self._rms = conditions.gust_rms_mps * np.array([1.0, 1.0, VERTICAL_GUST_SHARE])
        self._decay = math.exp(-step_s / conditions.gust_time_s)
        self._innovation = math.sqrt(1.0 - self._decay**2)
        self._is_calm = conditions.gust_rms_mps == 0.0 and not any(conditions.wind_ned_mps)
        self._gust = self._rms * self._random.standard_normal(3)

    def step(self) -> Vec3:
        """Return the velocity of the air in NED [m/s] for the next step."""
        if self._is_calm:
            return (0.0, 0.0, 0.0)
        noise = self._innovation * self._rms * self._random.standard_normal(3)
        self._gust = self._decay * self._gust + noise
        return vec3((self._mean + self._gust).tolist())


class SensorNoise:
    """White noise on sensed velocity, rates and specific force; position and attitude are exact."""

    def __init__(self, conditions: Conditions) -> None:
        self._random = np.random.Generator(np.random.PCG64((conditions.seed, 2)))
        velocity_mps, rate_radps = conditions.velocity_noise_mps, conditions.rate_noise_radps
        self._sigma = np.repeat((velocity_mps, rate_radps, conditions.specific_force_noise_mps2), 3)
        self._is_exact = not self._sigma.any()

    def sense(self, truth: BodyState) -> BodyState:
        if self._is_exact:
            return truth
        exact = (truth.velocity_ned_mps, truth.rate_body_radps, truth.specific_force_body_mps2)
        noise = self._sigma * self._random.standard_normal(9)
        velocity, rate, force = map(vec3, (np.ravel(exact) + noise).reshape(3, 3).tolist())
        return truth._replace(
            velocity_ned_mps=velocity, rate_body_radps=rate, specific_force_body_mps2=force
        )


SPIN_MIN = 0.05  # lowest thrust of an armed, flying motor


def clamp(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def clamp_axes(vector: complex, limit: float) -> complex:
    return complex(clamp(vector.real, limit), clamp(vector.imag, limit))


def shorten(vector: complex, limit: float) -> complex:
    """Limit a vector's length and keep its direction."""
    size = length(vector)
    return vector if size <= max(0.0, limit) else vector * (limit / size)


class HeightController:
    """Controller from climb rate demand to vertical acceleration; zero demand holds the height."""

    HEIGHT_GAIN_PER_S = 1.0
    CLIMB_GAIN_PER_S = 5.0
    INTEGRAL_GAIN_PER_S2 = 2.0
    MAX_INTEGRAL_MPS2 = 3.0
    MAX_HEIGHT_ERROR_M = 2.0
    MAX_ACCEL_MPS2 = 0.7 * GRAVITY_MPS2

    def __init__(self, step_s: float) -> None:
        self._step_s = step_s
        self._height_m = self._climb_mps = self._integral_mps2 = 0.0

    def reset(self, body: BodyState) -> None:
        self._height_m = -body.position_ned_m[2]
        self._climb_mps = -body.velocity_ned_mps[2]
        self._integral_mps2 = 0.0

    def update(self, body: BodyState, climb_mps: float, max_accel_mps2: float) -> float:
        """Return the upward acceleration [m/s^2]; ``max_accel_mps2`` limits the demand's change."""
        height, climb = -body.position_ned_m[2], -body.velocity_ned_mps[2]
        self._climb_mps += clamp(climb_mps - self._climb_mps, max_accel_mps2 * self._step_s)
        self._height_m += self._climb_mps * self._step_s
        self._height_m = height + clamp(self._height_m - height, self.MAX_HEIGHT_ERROR_M)
        wanted = self._climb_mps + self.HEIGHT_GAIN_PER_S * (self._height_m - height)
        error = wanted - climb
        self._integral_mps2 = clamp(
            self._integral_mps2 + self.INTEGRAL_GAIN_PER_S2 * error * self._step_s,
            self.MAX_INTEGRAL_MPS2,
        )
        accel = self.CLIMB_GAIN_PER_S * error + self._integral_mps2
        return clamp(accel, self.MAX_ACCEL_MPS2)


def thrust_for(accel_up_mps2: float, cos_tilt: float, hover: float) -> float:
    """Return the collective in [0, 1] for a vertical acceleration; tilt boost ends at 60
    degrees."""
    return max(0.0, min(1.0, hover * (1.0 + accel_up_mps2 / GRAVITY_MPS2) / max(cos_tilt, 0.5)))


def mix(
    collective: float, angular_accel_radps2: Vec3, airframe: Airframe = QUAD
) -> tuple[float, ...]:
    """Return four motor commands in [SPIN_MIN, 1]; priority: roll and pitch, yaw, then thrust."""
    ix, iy, iz = INERTIA_KGM2
    ax, ay, az = angular_accel_radps2
    per_arm = 4.0 * MOTOR_ARM_M * airframe.max_motor_thrust_n
    roll = clamp(ax * ix / per_arm, 0.25)
    pitch = clamp(ay * iy / per_arm, 0.25)
    yaw_room = max(0.05, 0.45 - abs(roll) - abs(pitch))
    yaw = clamp(az * iz / (4.0 * YAW_TORQUE_PER_THRUST_M * airframe.max_motor_thrust_n), yaw_room)
    turns = [left * roll + forward * pitch - forward * left * yaw for forward, left in MOTORS]
    collective = max(SPIN_MIN - min(turns), min(1.0 - max(turns), collective))
    return tuple(max(SPIN_MIN, min(1.0, collective + turn)) for turn in turns)
