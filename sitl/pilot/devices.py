"""Pilots at a gamepad (or a USB transmitter) or at the keyboard."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import pygame

from sitl.clock import NS_PER_S, Clock
from sitl.pilot.demonstrator import StickPositions
from sitl.pilot.transmitter import OFF_US, Gesture, Hand, PadAxes, Switch, Transmitter

RECORD_BUTTON, BAD_BUTTON, DISARM_BUTTON, ARM_BUTTON = 0, 1, 6, 7
"""A, B, back and start on a common pad."""
PAD_HELP = (
    "hold button 7 (start) to arm, 6 (back) to disarm; button 0 (A) moves the switch of channel 7 "
    "up and down, 1 (B) to its middle"
)


class _DevicePilot(ABC):
    """`Pilot` at a device: its transmitter, gestures and switch."""

    def __init__(self, clock: Clock, *, arm: int, disarm: int, up: int, middle: int) -> None:
        """Bind keys or buttons: the gestures, the switch up and down, the switch to its middle."""
        self._clock = clock
        self._transmitter = Transmitter(clock.now_ns())
        self._switch: Switch = "low"
        self._down: set[int] = set()
        self._arm, self._disarm, self._up, self._middle = arm, disarm, up, middle

    def latest(self) -> Sequence[int] | None:
        now_ns = self._clock.now_ns()
        if not self._transmitter.begins_frame(now_ns):
            return None
        if (sticks := self._poll(now_ns)) is None:
            return OFF_US
        gesture: Gesture | None = "arm" if self._arm in self._down else None
        if gesture is None and self._disarm in self._down:
            gesture = "disarm"
        return self._transmitter.channels_us(Hand(sticks, gesture, self._switch), now_ns)

    @abstractmethod
    def _poll(self, now_ns: int) -> StickPositions | None:
        """Process events. Return the sticks, or None while the receiver has no signal."""

    def _press(self, number: int) -> None:
        self._down.add(number)
        if number == self._up:
            self._switch = "low" if self._switch == "high" else "high"
        elif number == self._middle:
            self._switch = "middle"

    def close(self) -> None:
        pygame.quit()


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

    def buttons(self) -> Sequence[bool]:
        """Return the buttons' states, by number: True if pressed."""
        pad = self._pad
        return () if pad is None else [pad.get_button(k) for k in range(pad.get_numbuttons())]


class GamepadPilot(_DevicePilot):
    """Pilot at a gamepad; without the pad the receiver has no signal."""

    def __init__(self, pad: PygamePad, axes: PadAxes, clock: Clock) -> None:
        super().__init__(
            clock, arm=ARM_BUTTON, disarm=DISARM_BUTTON, up=RECORD_BUTTON, middle=BAD_BUTTON
        )
        self._pad = pad
        self._axes = axes

    def _poll(self, _now_ns: int) -> StickPositions | None:
        if not self._pad.poll():
            self._down.clear()
            return None
        for number, is_down in enumerate(self._pad.buttons()):
            if not is_down:
                self._down.discard(number)
            elif number not in self._down:
                self._press(number)
        return self._axes.sticks(self._pad.axes())


KEYS_HELP = (
    "W S climb, A D turn, arrows lean; hold Enter to arm, Backspace to disarm; Space moves the "
    "switch of channel 7 up and down, X to its middle"
)
DEFLECTION = 0.7  # share of full travel; full travel with Shift
TRAVEL_PER_S = 4.0
"""Speed at which sticks move towards the keys' demand, like a thumb's."""
_SIZE_PX = (460, 120)
_AXES = (
    (pygame.K_w, pygame.K_s),
    (pygame.K_d, pygame.K_a),
    (pygame.K_UP, pygame.K_DOWN),
    (pygame.K_RIGHT, pygame.K_LEFT),
)
"""Keys that move each stick up and down: throttle, yaw, pitch, roll."""


class KeyboardPilot(_DevicePilot):
    """Pilot at the keyboard; once its window is closed the receiver has no signal."""

    def __init__(self, clock: Clock) -> None:
        """Open the window. Raises pygame.error without a display."""
        pygame.display.init()
        pygame.display.set_caption(f"pilot: {KEYS_HELP}")
        pygame.display.set_mode(_SIZE_PX)
        super().__init__(
            clock,
            arm=pygame.K_RETURN,
            disarm=pygame.K_BACKSPACE,
            up=pygame.K_SPACE,
            middle=pygame.K_x,
        )
        self._moved_ns = clock.now_ns()
        self._position = [0.0] * len(_AXES)
        self._is_open = True

    def _poll(self, now_ns: int) -> StickPositions | None:
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                self._is_open = False
            elif event.type == pygame.WINDOWFOCUSLOST:
                self._down.clear()  # another window gets the key releases
            elif event.type == pygame.KEYUP:
                self._down.discard(event.key)
            elif event.type == pygame.KEYDOWN:
                self._press(event.key)
        return self._sticks(now_ns) if self._is_open else None

    def _sticks(self, now_ns: int) -> StickPositions:
        step = TRAVEL_PER_S * (now_ns - self._moved_ns) / NS_PER_S
        self._moved_ns = now_ns
        most = 1.0 if {pygame.K_LSHIFT, pygame.K_RSHIFT} & self._down else DEFLECTION
        for index, (up, down) in enumerate(_AXES):
            wanted = most * ((up in self._down) - (down in self._down))
            missing = wanted - self._position[index]
            self._position[index] += max(-step, min(step, missing))
        return StickPositions(*self._position)
