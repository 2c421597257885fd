"""A gamepad, or a transmitter on USB, as the pilot."""

from collections.abc import Sequence
from typing import Protocol

import pygame

from sitl.clock import NS_PER_S, Clock
from sitl.expert.demonstrator import StickPositions
from sitl.pilot.transmitter import OFF_US, Axes, Hand, Switch, Transmitter

RECORD_BUTTON, BAD_BUTTON, DISARM_BUTTON, ARM_BUTTON = 0, 1, 6, 7
"""A, B, back and start of the usual pad."""
PAD_HELP = (
    "hold button 7 (start) to arm, 6 (back) to disarm; button 0 (A) moves the switch of channel 7 "
    "up and down, 1 (B) to its middle"
)


class Pad(Protocol):
    """A gamepad as far as it is used here."""

    def poll(self) -> bool: ...

    def axes(self) -> Sequence[float]:
        """Positions in [-1, 1], by number."""

    def buttons(self) -> Sequence[bool]:
        """Those that are pressed, by number."""


class GamepadPilot:
    """A `Pilot`; without the pad the receiver has no signal."""

    def __init__(self, pad: Pad, axes: Axes, clock: Clock) -> None:
        self._pad = pad
        self._axes = axes
        self._clock = clock
        self._transmitter = Transmitter(clock.now_ns())
        self._switch: Switch = "low"
        self._pressed: set[int] = set()

    def latest(self) -> Sequence[int] | None:
        now_ns = self._clock.now_ns()
        if not self._transmitter.begins_frame(now_ns):
            return None
        if not self._pad.poll():
            self._pressed = set()
            return OFF_US
        pressed = {number for number, is_down in enumerate(self._pad.buttons()) if is_down}
        self._move_switch(pressed - self._pressed)
        self._pressed = pressed
        hand = Hand(sticks=self._axes.sticks(self._pad.axes()), switch=self._switch)
        if ARM_BUTTON in pressed:
            hand = hand._replace(gesture="arm")
        elif DISARM_BUTTON in pressed:
            hand = hand._replace(gesture="disarm")
        return self._transmitter.channels_us(hand, now_ns)

    def _move_switch(self, newly: set[int]) -> None:
        if RECORD_BUTTON in newly:
            self._switch = "low" if self._switch == "high" else "high"
        if BAD_BUTTON in newly:
            self._switch = "middle"

    def close(self) -> None:
        pygame.quit()


class PygamePad:
    """The first gamepad of this computer; another one may be plugged in in its place."""

    def __init__(self) -> None:
        pygame.display.init()  # events come through it
        pygame.joystick.init()
        self._pad: pygame.joystick.JoystickType | None = None

    @property
    def description(self) -> str | None:
        """Its name, and how many axes and buttons it has; None while there is none."""
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
        pad = self._pad
        return () if pad is None else [pad.get_axis(k) for k in range(pad.get_numaxes())]

    def buttons(self) -> Sequence[bool]:
        pad = self._pad
        return () if pad is None else [pad.get_button(k) for k in range(pad.get_numbuttons())]


KEYS_HELP = (
    "W S climb, A D turn, arrows lean; hold Enter to arm, Backspace to disarm; Space moves the "
    "switch of channel 7 up and down, X to its middle"
)
DEFLECTION = 0.7  # share of full travel; with Shift all of it
TRAVEL_PER_S = 4.0
"""Sticks move towards where the keys want them at this speed: a thumb's, and not a jump."""
_SIZE_PX = (460, 120)
_AXES = (
    (pygame.K_w, pygame.K_s),
    (pygame.K_d, pygame.K_a),
    (pygame.K_UP, pygame.K_DOWN),
    (pygame.K_RIGHT, pygame.K_LEFT),
)
"""Keys up and down each stick: throttle, yaw, pitch, roll."""


class KeyboardPilot:
    """A `Pilot`; with its window closed the receiver has no signal."""

    def __init__(self, clock: Clock) -> None:
        """Open the window; raises pygame.error without a display."""
        pygame.display.init()
        pygame.display.set_caption(f"pilot: {KEYS_HELP}")
        pygame.display.set_mode(_SIZE_PX)
        self._clock = clock
        self._transmitter = Transmitter(clock.now_ns())
        self._moved_ns = clock.now_ns()
        self._down: set[int] = set()
        self._position = [0.0] * len(_AXES)
        self._switch: Switch = "low"
        self._is_open = True

    def latest(self) -> Sequence[int] | None:
        now_ns = self._clock.now_ns()
        if not self._transmitter.begins_frame(now_ns):
            return None
        for event in pygame.event.get():
            self._take(event)
        if not self._is_open:
            return OFF_US
        hand = Hand(sticks=self._sticks(now_ns), switch=self._switch)
        if pygame.K_RETURN in self._down:
            hand = hand._replace(gesture="arm")
        elif pygame.K_BACKSPACE in self._down:
            hand = hand._replace(gesture="disarm")
        return self._transmitter.channels_us(hand, now_ns)

    def _take(self, event: pygame.event.Event) -> None:
        if event.type == pygame.QUIT:
            self._is_open = False
        elif event.type == pygame.WINDOWFOCUSLOST:
            self._down.clear()  # their releases go to another window
        elif event.type == pygame.KEYUP:
            self._down.discard(event.key)
        elif event.type == pygame.KEYDOWN:
            self._down.add(event.key)
            if event.key == pygame.K_SPACE:
                self._switch = "low" if self._switch == "high" else "high"
            elif event.key == pygame.K_x:
                self._switch = "middle"

    def _sticks(self, now_ns: int) -> StickPositions:
        step = TRAVEL_PER_S * (now_ns - self._moved_ns) / NS_PER_S
        self._moved_ns = now_ns
        most = 1.0 if {pygame.K_LSHIFT, pygame.K_RSHIFT} & self._down else DEFLECTION
        for index, (up, down) in enumerate(_AXES):
            wanted = most * ((up in self._down) - (down in self._down))
            missing = wanted - self._position[index]
            self._position[index] += max(-step, min(step, missing))
        return StickPositions(*self._position)

    def close(self) -> None:
        pygame.quit()
