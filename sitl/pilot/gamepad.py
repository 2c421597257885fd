"""Pilot at a gamepad or a USB transmitter."""

from collections.abc import Sequence

import pygame

from sitl.clock import Clock
from sitl.pilot.transmitter import Hand, PadAxes, Switch, Transmitter, pad_sticks
from sitl.simulated_vehicle import SimulatedVehicle

RECORD_BUTTON, BAD_BUTTON, DISARM_BUTTON, ARM_BUTTON = 0, 1, 6, 7
"""A, B, back and start on a common pad."""
PAD_HELP = (
    "button 7 (start) arms, 6 (back) disarms on the ground; 0 (A) moves the switch of channel 7 "
    "up and down, 1 (B) to its middle"
)


class PygamePad:
    """First gamepad of this computer; it may be unplugged and replaced."""

    def __init__(self) -> None:
        pygame.display.init()  # needed for events
        pygame.joystick.init()
        self._pad: pygame.joystick.JoystickType | None = None

    @property
    def description(self) -> str | None:
        """Name and numbers of axes and buttons; None without a pad."""
        if not self.poll() or self._pad is None:
            return None
        pad = self._pad
        return f"{pad.get_name()}: {pad.get_numaxes()} axes, {pad.get_numbuttons()} buttons"

    def poll(self) -> bool:
        """Read the pad. Return False if there is none."""
        pygame.event.clear()  # also looks for pads that come and go
        self._pad = pygame.joystick.Joystick(0) if pygame.joystick.get_count() else None
        return self._pad is not None

    def axes(self) -> Sequence[float]:
        """Return the positions in [-1, 1], by number."""
        pad = self._pad
        return () if pad is None else [pad.get_axis(k) for k in range(pad.get_numaxes())]

    def pressed(self) -> set[int]:
        """Return the numbers of the buttons that are pressed."""
        pad = self._pad
        return (
            set() if pad is None else {k for k in range(pad.get_numbuttons()) if pad.get_button(k)}
        )


class GamepadPilot(Transmitter):
    """Pilot at a gamepad: its sticks, arming buttons and switch.

    Without the pad the receiver has no signal.
    """

    def __init__(
        self, pad: PygamePad, axes: PadAxes, vehicle: SimulatedVehicle, clock: Clock
    ) -> None:
        super().__init__(clock.now_ns)
        self._pad = pad
        self._vehicle = vehicle
        self._axes = axes
        self._switch: Switch = "low"
        self._down: set[int] = set()

    def _hand(self, now_ns: int) -> Hand | None:
        if not self._pad.poll():
            self._down = set()
            return None
        before, self._down = self._down, self._pad.pressed()
        for number in self._down - before:
            if number == RECORD_BUTTON:
                self._switch = "low" if self._switch == "high" else "high"
            elif number == BAD_BUTTON:
                self._switch = "middle"
            elif number == DISARM_BUTTON:
                self._vehicle.ap.disarm(force=False)
            elif number == ARM_BUTTON:
                self._vehicle.ap.arm()
        return Hand(pad_sticks(self._axes, self._pad.axes()), self._switch)

    def close(self) -> None:
        pygame.quit()
