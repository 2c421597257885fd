"""The keyboard as the pilot: a small window takes the keys, since a terminal tells no release."""

from collections.abc import Sequence

import pygame

from sitl.clock import NS_PER_S, Clock
from sitl.expert.stick_response import StickPositions
from sitl.pilot.transmitter import OFF_US, Hand, Switch, Transmitter

HELP = (
    "W S climb, A D turn, arrows lean; hold Enter to arm, Backspace to disarm; Space moves the "
    "switch of channel 7 up and down, X to its middle"
)
DEFLECTION = 0.7
"""Share of full travel; with Shift all of it."""
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
        pygame.display.set_caption(f"pilot: {HELP}")
        pygame.display.set_mode(_SIZE_PX)
        self._clock = clock
        self._transmitter = Transmitter(clock.now_ns())
        self._moved_ns = clock.now_ns()
        self._down: set[int] = set()
        self._position = [0.0] * len(_AXES)
        self._switch: Switch = "low"
        self._is_open = True

    def latest(self) -> Sequence[int] | None:
        """See `Pilot`."""
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
        """See `Pilot`."""
        pygame.quit()
