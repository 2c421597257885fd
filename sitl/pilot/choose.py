"""The pilot that ``--pilot`` names, and a vehicle that obeys its receiver."""

import os
from typing import Literal

from sitl import UsageError
from sitl.clock import Clock
from sitl.course.layout import Course
from sitl.pilot.axes import parse_axes
from sitl.pilot.expert import ExpertPilot
from sitl.pilot.transmitter import Pilot
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import AutopilotName

PilotName = Literal["gamepad", "keyboard", "expert"]
NAMES: tuple[PilotName, ...] = ("gamepad", "keyboard", "expert")
_PX4_PARAMS = {"COM_RC_IN_MODE": 0.0, "COM_FLTMODE_BOOT": 1.0}
"""Sticks from the receiver alone; the mode after boot is Altitude."""


def prepare_vehicle(vehicle: SimulatedVehicle, autopilot: AutopilotName) -> None:
    """Have the vehicle fly by its receiver in ALT_HOLD or ALTCTL; to be called before it flies."""
    if autopilot == "px4":
        for name, value in _PX4_PARAMS.items():
            vehicle.params.set(name, value)
        vehicle.reboot()


def make_pilot(
    name: PilotName,
    *,
    vehicle: SimulatedVehicle,
    autopilot: AutopilotName,
    course: Course,
    axes: str,
    speed_mps: float,
    clock: Clock,
) -> tuple[Pilot, str]:
    """The pilot, and a line for the user about it.

    Raises:
        UsageError: its package, display or vehicle is missing, or ``axes`` cannot be read.
    """
    if name == "expert":
        if autopilot != "ardupilot":
            raise UsageError("--pilot expert knows the sticks of ardupilot alone")
        expert = ExpertPilot(vehicle, course, speed_mps=speed_mps)
        return expert, f"the expert flies at {speed_mps:g} m/s"
    wanted = parse_axes(axes)
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # a line of its own on every import
    try:
        import pygame

        from sitl.pilot import gamepad, keyboard
    except ModuleNotFoundError as error:
        if error.name != "pygame":
            raise
        raise UsageError(f"--pilot {name} needs pygame: pip install pygame-ce") from error
    try:
        if name == "keyboard":
            return keyboard.KeyboardPilot(clock), keyboard.HELP
        pad = gamepad.PygamePad()
    except pygame.error as error:
        raise UsageError(f"--pilot {name} needs a display: {error}") from error
    found = pad.description or "no gamepad yet: plug one in (until then the receiver has no signal)"
    return gamepad.GamepadPilot(pad, wanted, clock), f"{found}; {gamepad.HELP}"
