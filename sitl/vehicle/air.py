"""The air that the vehicle flies through, and what its sensors add to the truth."""

import math

import numpy as np

from sitl.rotation import Vec3
from sitl.vehicle.conditions import Conditions
from sitl.vehicle.dynamics import BodyState

STILL: Vec3 = (0.0, 0.0, 0.0)
VERTICAL_SHARE = 0.5
"""Of the gusts' strength: near the ground the air moves along it."""


class Air:
    """Steady wind and gusts, by control step.

    Gusts are a first-order Gauss-Markov process per axis: the longitudinal Dryden spectrum as seen
    by a vehicle whose passage through the turbulence takes ``gust_time_s`` (MIL-F-8785C).
    """

    def __init__(self, conditions: Conditions, step_s: float) -> None:
        self._random = np.random.Generator(np.random.PCG64((conditions.seed, 1)))
        self._mean = np.array(conditions.wind_ned_mps)
        self._rms = conditions.gust_rms_mps * np.array([1.0, 1.0, VERTICAL_SHARE])
        self._kept = math.exp(-step_s / conditions.gust_time_s)
        self._fresh = math.sqrt(1.0 - self._kept**2)
        self._moves = conditions.gust_rms_mps > 0.0 or any(conditions.wind_ned_mps)
        self._gust = self._rms * self._random.standard_normal(3)

    def step(self) -> Vec3:
        """Velocity of the air in NED, m/s."""
        if not self._moves:
            return STILL
        fresh = self._fresh * self._rms * self._random.standard_normal(3)
        self._gust = self._kept * self._gust + fresh
        north, east, down = (self._mean + self._gust).tolist()
        return (north, east, down)


class SensorNoise:
    """White noise on what the autopilot senses; position and attitude are left alone."""

    def __init__(self, conditions: Conditions) -> None:
        self._random = np.random.Generator(np.random.PCG64((conditions.seed, 2)))
        self._sigma = np.repeat(
            [
                conditions.velocity_noise_mps,
                conditions.rate_noise_radps,
                conditions.specific_force_noise_mps2,
            ],
            3,
        )
        self._noisy = bool(self._sigma.any())

    def sense(self, truth: BodyState) -> BodyState:
        """What is measured of this state."""
        if not self._noisy:
            return truth
        noise = (self._sigma * self._random.standard_normal(9)).tolist()
        return truth._replace(
            velocity_ned_mps=_sum(truth.velocity_ned_mps, noise[0:3]),
            rate_body_radps=_sum(truth.rate_body_radps, noise[3:6]),
            specific_force_body_mps2=_sum(truth.specific_force_body_mps2, noise[6:9]),
        )


def _sum(value: Vec3, noise: list[float]) -> Vec3:
    x, y, z = value
    return (x + noise[0], y + noise[1], z + noise[2])
