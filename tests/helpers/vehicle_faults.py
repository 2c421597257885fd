"""Scripted faults inside the simulated vehicle: frozen sensors, a reboot."""

from collections.abc import Iterable
from dataclasses import dataclass

from sitl.clock import NS_PER_S
from sitl.simulated_vehicle import SimulatedVehicle


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorFreeze:
    """Telemetry and control keep the last state for a while; the vehicle flies on blindly."""

    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Reboot:
    """Restart of the autopilot: time_boot_ms falls back to 0."""

    at_s: float


class VehicleFaults:
    """Script of vehicle faults; times are seconds since ``start_ns``."""

    def __init__(self, script: Iterable[SensorFreeze | Reboot], start_ns: int) -> None:
        script = tuple(script)
        self._start_ns = start_ns
        self._freezes = [fault for fault in script if isinstance(fault, SensorFreeze)]
        self._reboots_s = sorted(fault.at_s for fault in script if isinstance(fault, Reboot))

    def apply(self, vehicle: SimulatedVehicle, now_ns: int) -> None:
        """Apply the faults that are due. Call before each step."""
        t_s = (now_ns - self._start_ns) / NS_PER_S
        while self._reboots_s and t_s >= self._reboots_s[0]:
            self._reboots_s.pop(0)
            vehicle.reboot()
        vehicle.ap.sensors_frozen = any(f.start_s <= t_s < f.end_s for f in self._freezes)
