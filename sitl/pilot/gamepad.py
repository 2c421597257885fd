"""Pilot at a gamepad or a USB transmitter."""

from collections.abc import Sequence

import pygame

from sitl.clock import Clock
from sitl.pilot.transmitter import ARM, DISARM, Hand, PadAxes, Switch, Transmitter, pad_sticks

RECORD_BUTTON, BAD_BUTTON, DISARM_BUTTON, ARM_BUTTON = 0, 1, 6, 7
"""A, B, back and start on a common pad."""
PAD_HELP = (
    "hold button 7 (start) to arm, 6 (back) to disarm; button 0 (A) moves the switch of channel 7 "
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
        for event in pygame.event.get():
            is_ours = self._pad is not None and (
                getattr(event, "instance_id", None) == self._pad.get_instance_id()
            )
            if event.type == pygame.JOYDEVICEREMOVED and is_ours:
                self._pad = None
        if self._pad is None and pygame.joystick.get_count():
            self._pad = pygame.joystick.Joystick(0)
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
    """`Pilot` at a gamepad: its sticks, gestures and switch.

    Without the pad the receiver has no signal.
    """

    def __init__(self, pad: PygamePad, axes: PadAxes, clock: Clock) -> None:
        super().__init__(clock.now_ns)
        self._pad = pad
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
        sticks = pad_sticks(self._axes, self._pad.axes())
        if DISARM_BUTTON in self._down:
            sticks = DISARM
        if ARM_BUTTON in self._down:
            sticks = ARM
        return Hand(sticks, self._switch)

    def close(self) -> None:
        pygame.quit()
