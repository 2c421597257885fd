"""Detection of crashes from the ticks of a flight."""

import math

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Tick
from mavbridge.core.rotation import tilt_rad
from mavbridge.core.vehicle import VehicleText, recorded_text
from policy.contract import QUATERNION

OVERTURNED_NS = 500 * NS_PER_MS
"""Shortest time armed beyond 90 degrees of tilt that counts as a crash; a flip takes less."""
FALL_NS = NS_PER_S
"""Window after a disarming for a fall, which reaches 9.8 m/s in 1 s, and for a late crash message.
Later ones are the checks before the next arming, such as "PreArm: CrashDump data detected"."""
FALL_MPS = 1.5
"""Speed while disarmed that counts as a fall; a vehicle at rest reports less, any fall more."""
_WORDS = ("crash", "flight termination", "lockdown")
"""Words in the crash messages of ArduPilot ("Crash: Disarming") and PX4 ("Flight termination
active", "Lockdown")."""
_PILOTS = because(Code.PILOT_FLIES)
"""Reason of every tick in a pilot's recording."""


class CrashWatch:
    """Crash detector. It takes the ticks of a flight in order; ``reason`` is the first crash.

    A fall counts if the policy had control when the vehicle was last armed, or in a pilot's
    recording; a pilot who has taken over may disarm in the air.
    """

    def __init__(self) -> None:
        self.reason: str | None = None
        self._over_since_ns: int | None = None
        self._was_armed = self._counts_falls = False
        self._disarmed_ns = 0

    def see(self, tick: Tick) -> None:
        """Process one tick."""
        if tick.armed:  # the guard releases in the pass in which it sees a disarming
            is_ours = tick.phase in ("flying", "leaving")
            self._counts_falls = is_ours or tick.release_reason == _PILOTS
        was_armed, self._was_armed = self._was_armed, tick.armed
        if was_armed and not tick.armed:
            self._disarmed_ns = tick.woke_ns
        is_soon = tick.woke_ns - self._disarmed_ns <= FALL_NS
        may_fall = self._counts_falls and is_soon
        if self.reason is None and (tick.armed or was_armed or may_fall):
            self.reason = self._said(tick) or self._overturned(tick)
            if may_fall:
                self.reason = self.reason or self._fallen(tick)

    def _said(self, tick: Tick) -> str | None:
        for text in map(recorded_text, tick.texts):
            if isinstance(text, VehicleText) and any(word in text.lower() for word in _WORDS):
                return f"the vehicle said {text.said!r}"
        return None

    def _overturned(self, tick: Tick) -> str | None:
        if (
            tick.state is None
            or not tick.armed
            or tilt_rad(tick.state.values[QUATERNION].tolist()) <= math.pi / 2
        ):
            self._over_since_ns = None
            return None
        if self._over_since_ns is None:
            self._over_since_ns = tick.woke_ns
        is_long = tick.woke_ns - self._over_since_ns >= OVERTURNED_NS
        return "it lay on its back while armed" if is_long else None

    def _fallen(self, tick: Tick) -> str | None:
        if tick.armed or tick.state is None or tick.state.speed_mps < FALL_MPS:
            return None
        return f"it was disarmed in the air, and moved at {tick.state.speed_mps:.1f} m/s"
