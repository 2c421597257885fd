"""When an episode begins and ends, and which mark it gets; a state machine without I/O."""

from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.switch import Position, Switch

QUIT_KEY, TOGGLE_KEY, GOOD_KEY, BAD_KEY = "q", "r", "g", "b"
KEYS = (QUIT_KEY, TOGGLE_KEY, " ", GOOD_KEY, BAD_KEY)
KEYS_HINT = "r or space begins and ends an episode, g marks it as good, b as bad, q ends"
AFTER_DISARM_NS = NS_PER_S
"""Recorded after disarming: time for a fall to show that it was in the air."""
MIDDLE_NS = 300 * NS_PER_MS
"""A switch that is on its way from high to low passes the middle within this time."""

Mark: TypeAlias = Literal["good", "bad"]
_MARKS: dict[str, Mark] = {GOOD_KEY: "good", BAD_KEY: "bad"}


class Seen(NamedTuple):
    """What decides about episodes, at one moment."""

    now_ns: int
    armed: bool
    switch_us: int
    """The channel of the switch; 0 = no reading."""
    is_recording: bool
    keys: str = ""
    """Typed since the last moment, in order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Orders:
    """Do this, in this order."""

    mark_before: Mark | None = None
    """Mark of the episode that is being recorded, or else of the last one."""
    end: str | None = None
    """End the episode that is being recorded, for this reason."""
    begin: str | None = None
    """Begin one, for this reason."""
    quit: bool = False


class EpisodeControl:
    """Call ``step`` some twenty times a second."""

    def __init__(self, *, has_switch: bool, on_arm: bool) -> None:
        self._has_switch = has_switch
        self._on_arm = on_arm
        self._switch = Switch(rests=("low", "middle"))
        self._position: Position | None = None
        """As last read, whatever came between."""
        self._middle_since_ns: int | None = None
        """When the switch came from high to the middle."""
        self._was_armed = False
        self._disarmed_ns: int | None = None
        self._wanted: str | None = None
        """Why the switch or the arming wants an episode that could not begin yet."""

    def step(self, seen: Seen) -> Orders:
        """Advance to this moment."""
        keyed = self._by_keys(seen)
        switched = self._by_switch(seen) if self._has_switch else Orders()
        armed = self._by_arming(seen) if self._on_arm else Orders()
        self._keep_wanting(seen, switched.begin or armed.begin)
        every = (keyed, switched, armed)
        return Orders(
            mark_before=next((o.mark_before for o in every if o.mark_before), None),
            end=next((o.end for o in every if o.end), None),
            begin=keyed.begin or self._wanted,
            quit=keyed.quit,
        )

    def _keep_wanting(self, seen: Seen, begin: str | None) -> None:
        """Ask again for as long as the switch is high, or the vehicle armed: what was missing for
        an episode may come."""
        is_on = self._position == "high" if self._has_switch else seen.armed
        if begin is not None:
            self._wanted = begin
        elif seen.is_recording or not is_on:
            self._wanted = None

    def _by_keys(self, seen: Seen) -> Orders:
        marks = [_MARKS[key] for key in seen.keys if key in _MARKS]
        is_toggled = sum(seen.keys.count(key) for key in (TOGGLE_KEY, " ")) % 2 == 1
        is_over = QUIT_KEY in seen.keys
        return Orders(
            mark_before=marks[-1] if marks else None,
            end="a key" if seen.is_recording and (is_toggled or is_over) else None,
            begin="a key" if is_toggled and not (seen.is_recording or is_over) else None,
            quit=is_over,
        )

    def _by_switch(self, seen: Seen) -> Orders:
        is_act = self._switch.read(seen.switch_us, seen.now_ns)
        before, now = self._position, self._switch.position or self._position
        self._position = now
        if now == "high":
            self._middle_since_ns = None
            return Orders(begin="the switch") if is_act else Orders()
        if before == "high":
            self._middle_since_ns = seen.now_ns if now == "middle" else None
            return Orders(end="the switch") if seen.is_recording else Orders()
        since_ns = self._middle_since_ns
        if now == "low":
            self._middle_since_ns = None
        elif since_ns is not None and seen.now_ns - since_ns >= MIDDLE_NS:
            self._middle_since_ns = None
            return Orders(mark_before="bad")
        return Orders()

    def _by_arming(self, seen: Seen) -> Orders:
        was_armed, self._was_armed = self._was_armed, seen.armed
        if seen.armed:
            self._disarmed_ns = None
            return Orders() if was_armed or seen.is_recording else Orders(begin="armed")
        if was_armed:
            self._disarmed_ns = seen.now_ns
        is_over = (
            self._disarmed_ns is not None and seen.now_ns - self._disarmed_ns >= AFTER_DISARM_NS
        )
        if not is_over:
            return Orders()
        self._disarmed_ns = None
        return Orders(end="disarmed") if seen.is_recording else Orders()
