"""Newest reading of each quantity, from the best message that carries it."""

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.records import Reading, Telemetry
from mavbridge.mavlink.codec.messages import Attitude, LocalVelocity, SpecificForce

_YIELD_NS = 300 * NS_PER_MS
"""How long a better message may be silent before a worse one takes its place."""

_FORCE_RANK = {"HIGHRES_IMU": 0, "RAW_IMU": 1, "SCALED_IMU": 1, "SCALED_IMU2": 2}
"""Float m/s^2 first, then the first IMU in milli-g, then the second."""


class TelemetryJoiner:
    """Joins messages into one ``Telemetry``; a worse source never overwrites a better, live one."""

    def __init__(self) -> None:
        self._attitude: tuple[int, Reading, Reading] | None = None
        self._force: tuple[int, Reading] | None = None
        self._velocity: Reading | None = None

    def attitude(self, message: Attitude, arrived_ns: int) -> None:
        """Take attitude and body rates."""
        rank = 0 if message.is_quaternion else 1
        held = self._attitude
        if held is None or rank <= held[0] or arrived_ns - held[1].arrived_ns > _YIELD_NS:
            self._attitude = (
                rank,
                Reading(arrived_ns, message.ned_from_body_wxyz),
                Reading(arrived_ns, message.rate_body_radps),
            )

    @property
    def attitude_ns(self) -> int:
        """Arrival of the newest attitude; 0 before the first."""
        return self._attitude[1].arrived_ns if self._attitude else 0

    def velocity(self, message: LocalVelocity, arrived_ns: int) -> None:
        """Take velocity."""
        self._velocity = Reading(arrived_ns, message.velocity_ned_mps)

    def force(self, message: SpecificForce, arrived_ns: int) -> None:
        """Take specific force."""
        rank = _FORCE_RANK[message.source]
        held = self._force
        if held is None or rank <= held[0] or arrived_ns - held[1].arrived_ns > _YIELD_NS:
            self._force = (rank, Reading(arrived_ns, message.specific_force_body_mps2))

    def snapshot(self) -> Telemetry:
        """All that is known now."""
        return Telemetry(
            ned_from_body_wxyz=self._attitude[1] if self._attitude else None,
            rate_body_radps=self._attitude[2] if self._attitude else None,
            velocity_ned_mps=self._velocity,
            specific_force_body_mps2=self._force[1] if self._force else None,
        )
