"""Newest reading of each quantity, from the best message that carries it."""

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.vehicle import Reading, Telemetry
from mavbridge.mavlink.codec.messages import Attitude, LocalVelocity, SpecificForce

_YIELD_NS = 300 * NS_PER_MS
"""Silence after which a better message gives way to a worse one."""

_FORCE_RANK = {"HIGHRES_IMU": 0, "RAW_IMU": 1, "SCALED_IMU": 1, "SCALED_IMU2": 2}
"""Float m/s^2 first, then the first IMU in milli-g, then the second."""


class _BestReading:
    """Readings of one quantity; a worse message never replaces a better one that still comes."""

    def __init__(self) -> None:
        self._rank = 0
        self.newest: Reading | None = None

    def offer(self, rank: int, reading: Reading) -> None:
        """Take a reading; a lower rank is better."""
        held = self.newest
        if held is None or rank <= self._rank or reading.arrived_ns - held.arrived_ns > _YIELD_NS:
            self._rank, self.newest = rank, reading


class TelemetryCollector:
    """Joins messages into one ``Telemetry``."""

    def __init__(self) -> None:
        self._attitude, self._rate, self._force = _BestReading(), _BestReading(), _BestReading()
        self._velocity: Reading | None = None

    def receive(self, body: Attitude | LocalVelocity | SpecificForce, arrived_ns: int) -> None:
        """Take a message."""
        match body:
            case Attitude():
                rank = 0 if body.is_quaternion else 1
                self._attitude.offer(rank, Reading(arrived_ns, body.ned_from_body_wxyz))
                self._rate.offer(rank, Reading(arrived_ns, body.rate_body_radps))
            case LocalVelocity():
                self._velocity = Reading(arrived_ns, body.velocity_ned_mps)
            case SpecificForce():
                reading = Reading(arrived_ns, body.specific_force_body_mps2)
                self._force.offer(_FORCE_RANK[body.message_name], reading)

    @property
    def attitude_ns(self) -> int:
        """Arrival of the newest attitude; 0 before the first."""
        return self._attitude.newest.arrived_ns if self._attitude.newest else 0

    def snapshot(self) -> Telemetry:
        """The newest reading of each quantity."""
        return Telemetry(
            ned_from_body_wxyz=self._attitude.newest,
            rate_body_radps=self._rate.newest,
            velocity_ned_mps=self._velocity,
            specific_force_body_mps2=self._force.newest,
        )
