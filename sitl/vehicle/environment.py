"""Wind around the vehicle, and noise of its sensors."""

import math

import numpy as np

from sitl.rotation import Vec3
from sitl.vehicle.conditions import Conditions
from sitl.vehicle.dynamics import BodyState

VERTICAL_GUST_SHARE = 0.5
"""Vertical over horizontal gust strength: near the ground the air moves along it."""


class Wind:
    """Steady wind and gusts, one value per control step.

    Gusts are a first-order Gauss-Markov process per axis: the longitudinal Dryden spectrum as seen
    by a vehicle whose passage through the turbulence takes ``gust_time_s`` (MIL-F-8785C).
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
        """Velocity of the air in NED, m/s, for the next step."""
        if self._is_calm:
            return (0.0, 0.0, 0.0)
        noise = self._innovation * self._rms * self._random.standard_normal(3)
        self._gust = self._decay * self._gust + noise
        north, east, down = (self._mean + self._gust).tolist()
        return (north, east, down)


class SensorNoise:
    """White noise on sensed velocity, rates and specific force; position and attitude are exact."""

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
        self._is_exact = not self._sigma.any()

    def sense(self, truth: BodyState) -> BodyState:
        """The state as the sensors report it."""
        if self._is_exact:
            return truth
        exact = (truth.velocity_ned_mps, truth.rate_body_radps, truth.specific_force_body_mps2)
        noise = self._sigma * self._random.standard_normal(9)
        sensed = (np.ravel(exact) + noise).tolist()
        return truth._replace(
            velocity_ned_mps=tuple(sensed[0:3]),
            rate_body_radps=tuple(sensed[3:6]),
            specific_force_body_mps2=tuple(sensed[6:9]),
        )
