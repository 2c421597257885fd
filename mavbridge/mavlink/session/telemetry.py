"""Newest reading of each quantity, from the best message that carries it."""

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.vehicle import Reading, Telemetry
from mavbridge.mavlink.codec.messages import (
    RESTART_STAMPS,
    RESTART_STEP_US,
    Altitude,
    Attitude,
    LocalVelocity,
    Measurement,
    later_by_us,
)

_YIELD_NS = 300 * NS_PER_MS
"""Silence after which a better message gives way to a worse one."""

_FORCE_RANK = {"HIGHRES_IMU": 0, "RAW_IMU": 1, "SCALED_IMU": 1, "SCALED_IMU2": 2}
"""Float m/s^2 first, then the first IMU in milli-g, then the second."""


class _Filter:
    """Decides which messages of one quantity are taken.

    A worse message never replaces a better one that still comes, nor a datagram that is late or
    doubled the one that overtook it: the vehicle's own stamps decide.
    """

    def __init__(self) -> None:
        self._rank = 0
        self._arrived_ns: int | None = None
        self._happened_ns = 0
        self._boot_us = 0
        self._old_stamps = 0

    def delay_ns(self, rank: int, boot_us: int, arrived_ns: int, happened_ns: int) -> int | None:
        """Delay of a message that is taken, or None; a lower rank is better.

        It is negative where the message is stamped in the future.
        """
        if self._arrived_ns is not None:
            if rank > self._rank and arrived_ns - self._arrived_ns <= _YIELD_NS:
                return None
            later_us = later_by_us(boot_us, self._boot_us)
            if boot_us > 0 >= later_us:
                self._old_stamps = self._old_stamps + 1 if later_us < -RESTART_STEP_US else 0
                if self._old_stamps < RESTART_STAMPS:
                    return None
            if happened_ns < self._happened_ns:
                # By a better offset of the clocks; but what is newer happened later.
                happened_ns = self._happened_ns
        self._rank, self._boot_us, self._old_stamps = rank, boot_us, 0
        self._arrived_ns = arrived_ns
        self._happened_ns = happened_ns if happened_ns < arrived_ns else arrived_ns
        return arrived_ns - happened_ns


class TelemetryCollector:
    """Joins messages into one ``Telemetry``."""

    def __init__(self) -> None:
        self._attitude_filter, self._velocity_filter = _Filter(), _Filter()
        self._force_filter, self._height_filter = _Filter(), _Filter()
        self._attitude: Reading | None = None
        self._rate: Reading | None = None
        self._velocity: Reading | None = None
        self._force: Reading | None = None
        self._position: Reading | None = None
        self._height: Reading | None = None

    def receive(self, body: Measurement, arrived_ns: int, happened_ns: int) -> None:
        """Take a message, with its arrival and the time that it tells about."""
        boot_us = body.boot_us
        if isinstance(body, Attitude):
            rank = 0 if body.is_quaternion else 1
            delay_ns = self._attitude_filter.delay_ns(rank, boot_us, arrived_ns, happened_ns)
            if delay_ns is not None:
                self._attitude = Reading(arrived_ns, body.ned_from_body_wxyz, delay_ns)
                self._rate = Reading(arrived_ns, body.rate_body_radps, delay_ns)
        elif isinstance(body, LocalVelocity):
            delay_ns = self._velocity_filter.delay_ns(0, boot_us, arrived_ns, happened_ns)
            if delay_ns is not None:
                self._velocity = Reading(arrived_ns, body.velocity_ned_mps, delay_ns)
                if body.position_ned_m is not None:
                    self._position = Reading(arrived_ns, body.position_ned_m, delay_ns)
        elif isinstance(body, Altitude):
            delay_ns = self._height_filter.delay_ns(0, boot_us, arrived_ns, happened_ns)
            if delay_ns is not None:
                self._height = Reading(arrived_ns, (body.above_home_m,), delay_ns)
        else:
            rank = _FORCE_RANK[body.message_name]
            delay_ns = self._force_filter.delay_ns(rank, boot_us, arrived_ns, happened_ns)
            if delay_ns is not None:
                self._force = Reading(arrived_ns, body.specific_force_body_mps2, delay_ns)

    @property
    def attitude_arrived_ns(self) -> int:
        """Arrival of the newest attitude; 0 before the first."""
        return 0 if self._attitude is None else self._attitude.arrived_ns

    def snapshot(self) -> Telemetry:
        """The newest reading of each quantity."""
        return Telemetry(
            ned_from_body_wxyz=self._attitude,
            rate_body_radps=self._rate,
            velocity_ned_mps=self._velocity,
            specific_force_body_mps2=self._force,
            position_ned_m=self._position,
            height_above_home_m=self._height,
        )
