"""Stick input: choice between senders, loss, a pilot's takeover, and stick curves.

PX4 has no overrides: each link, and the receiver, is a source. COM_RC_IN_MODE selects which source
may win, and the winner's last values hold until it is declared lost. Timers and limits are those
measured on PX4 1.18. Detectors of a pilot's movement are those of ``src/modules/manual_control`` in
1.18 and in 1.14 to 1.17 (upstream commit cf50ecf41b).
"""

import math
from typing import NamedTuple

from sitl.clock import NS_PER_S
from sitl.px4.params import Px4Params
from sitl.vehicle.dynamics import GRAVITY_MPS2
from sitl.vehicle.rotation import length

RC_SOURCE = -1  # the receiver; links are numbered from 0
POLL_NS = NS_PER_S // 5
"""Sticks are checked at each arrival or after this period, and once a second for the switches."""
FAST_SAMPLES = 3
"""1.18: consecutive movements in one direction that count as a pilot's (MIN_SIGN_CONSECUTIVE).
Samples at rest in between do not count, so a stick that has come to rest keeps its count."""
OLD_TAU_S, TAU_S = 0.1, 0.05  # low-pass of a stick's speed, before 1.18 and in 1.18

_RECEIVER_ONLY, _LINKS_ONLY, _NONE, *_PRIORITIES = 0, 1, 4, 5, 6, 7, 8
"""Values of COM_RC_IN_MODE. 2 takes any source, and keeps it until it is lost. From 5 on a source
replaces a lower one at once: 6 and 8 prefer links to the receiver, 7 and 8 the highest link."""
EXPO = 0.6
"""Expo of climb, yaw and POSCTL's speed: 0.4 x + 0.6 x^3 beyond a dead zone, as measured. Leans
have no dead zone; they are linear in the tangent in ALTCTL, in the angle in STAB."""


class Px4Sticks(NamedTuple):
    """Positions in [-1, 1]; throttle 0 is the middle."""

    forward: float = 0.0  # + nose down
    right: float = 0.0
    throttle: float = 0.0
    yaw: float = 0.0  # + nose right

    @property
    def lean(self) -> complex:
        """Forward + 1j * right."""
        return complex(self.forward, self.right)


def from_manual_control(x: int, y: int, z: int, r: int) -> Px4Sticks:
    """Convert a MANUAL_CONTROL; a field beyond its range counts as centred."""
    forward, right, yaw = (v / 1000.0 if -1000 <= v <= 1000 else 0.0 for v in (x, y, r))
    return Px4Sticks(forward, right, z / 500.0 - 1.0 if 0 <= z <= 1000 else 0.0, yaw)


class StickSpeed:
    """Low-passed speed of one stick: PX4's ``MovingDiff`` with its ``AlphaFilter``."""

    def __init__(self) -> None:
        self.per_s = 0.0
        self.moves = 0  # consecutive ones in one direction, + up
        self._last: float | None = None

    def update(self, value: float, dt_s: float, tau_s: float) -> None:
        """Take a sample; the first one after a reset is no movement."""
        last, self._last = self._last, value
        if last is None or dt_s <= 0.0:
            return
        self.per_s += dt_s / (tau_s + dt_s) * ((value - last) / dt_s - self.per_s)
        if value != last:
            step = 1 if value > last else -1
            self.moves = step + (self.moves if self.moves * step > 0 else 0)


class StickInput:
    """Sticks that PX4 acts on. Stamps are nanoseconds of one clock."""

    def __init__(self, params: Px4Params) -> None:
        self._params = params
        self.sticks = Px4Sticks()
        self.valid = False  # the winner is still sending
        self.count = 0
        """Samples published so far. Without news each poll repeats the last, as does the loss."""
        self.sampled_ns = 0
        self.moved_fast = False
        """A stick moves faster than COM_RC_STICK_OV or MAN_OVERRIDE_SPD."""
        self._source: int | None = None
        self._unread: dict[int, Px4Sticks] = {}
        """Samples of sources that did not win, since the last check."""
        self._never_ages = False
        self._speeds = tuple(StickSpeed() for _ in Px4Sticks())
        self._looked_ns = self._switches_ns = 0

    @property
    def source(self) -> int | None:
        return self._source if self.valid else None

    def pretend_centred(self, now_ns: int) -> None:
        """Treat the sticks as valid and centred until the first real ones come."""
        self._choose(Px4Sticks(), now_ns)
        self._never_ages = True

    def on_sticks(self, source: int, sticks: Px4Sticks, now_ns: int) -> None:
        if self._wins(source):
            self._source = source
            self._choose(sticks, now_ns)
            return
        self._unread[source] = sticks
        if source == RC_SOURCE and now_ns - self._switches_ns >= NS_PER_S:
            self._switches_ns = now_ns
            self._check(now_ns)

    def update(self, now_ns: int) -> None:
        """Check sticks between arrivals, and detect the loss of the winner."""
        if now_ns - self._looked_ns >= POLL_NS:
            self._check(now_ns)

    def _check(self, now_ns: int) -> None:
        lost_after_ns = round(self._params["COM_RC_LOSS_T"], 6) * NS_PER_S
        if self.valid and not self._never_ages and now_ns - self.sampled_ns >= lost_after_ns:
            unread, self._unread, self.valid = self._unread, {}, False
            for source, sticks in unread.items():  # one that follows in this check: no failsafe
                self.on_sticks(source, sticks, now_ns)
            if not self.valid:
                self.count, self.moved_fast = self.count + 1, False
                self._speeds = tuple(StickSpeed() for _ in Px4Sticks())
        elif self.valid:
            self._look(now_ns)

    def _wins(self, source: int) -> bool:
        mode = self._params.integer("COM_RC_IN_MODE")
        if mode == (_LINKS_ONLY if source == RC_SOURCE else _RECEIVER_ONLY) or mode == _NONE:
            return False
        if not self.valid or self._never_ages or self._source is None or source == self._source:
            return True
        prefers_higher = mode in ((6, 8) if RC_SOURCE in (source, self._source) else (7, 8))
        return mode in _PRIORITIES and prefers_higher is (source > self._source)

    def _look(self, now_ns: int) -> None:
        """Detect movement since the last check, by the detector of the release."""
        is_old = "COM_RC_STICK_OV" in self._params
        dt_s, self._looked_ns = (now_ns - self._looked_ns) / NS_PER_S, now_ns
        self._unread.clear()
        self.count += 1
        limit = self._params["COM_RC_STICK_OV" if is_old else "MAN_OVERRIDE_SPD"]
        limit_per_s = 0.01 * limit if is_old else limit
        moves, tau_s = (0, OLD_TAU_S) if is_old else (FAST_SAMPLES, TAU_S)

        def is_fast(speed: StickSpeed, value: float) -> bool:
            speed.update(value, dt_s, tau_s)
            return abs(speed.per_s) > limit_per_s and abs(speed.moves) >= moves

        # PX4 looks at a stick only if those before it rest, and then sees all of its movement.
        forward, right, throttle, yaw = self.sticks
        values = (right, forward, yaw, throttle)
        self.moved_fast = limit_per_s > 0.0 and any(map(is_fast, self._speeds, values))

    def _choose(self, sticks: Px4Sticks, now_ns: int) -> None:
        self.sticks, self.sampled_ns, self.valid = sticks, now_ns, True
        self._look(now_ns)
        self._never_ages = False


def curve(value: float, dead_zone: float) -> float:
    """Apply dead zone and expo to a stick in [-1, 1]."""
    beyond = max(0.0, abs(value) - dead_zone) / (1.0 - dead_zone)
    return math.copysign((1.0 - EXPO) * beyond + EXPO * beyond**3, value)


def climb_mps(sticks: Px4Sticks, params: Px4Params) -> float:
    """Return the climb rate of ALTCTL and POSCTL, + up."""
    share = curve(sticks.throttle, params.dead_zone)
    return share * params["MPC_Z_VEL_MAX_UP" if share > 0.0 else "MPC_Z_VEL_MAX_DN"]


def yaw_rate_radps(sticks: Px4Sticks, params: Px4Params) -> float:
    share = curve(sticks.yaw, params.dead_zone)
    return math.radians(params["MPC_MAN_Y_MAX"]) * share


def lean_accel_mps2(sticks: Px4Sticks, params: Px4Params) -> complex:
    """Return ALTCTL's acceleration, forward + 1j * right; both sticks share MPC_MAN_TILT_MAX."""
    full = GRAVITY_MPS2 * math.tan(math.radians(params["MPC_MAN_TILT_MAX"]))
    return sticks.lean * (full / max(1.0, length(sticks.lean)))


def lean_rad(sticks: Px4Sticks, params: Px4Params) -> tuple[float, float]:
    """Return roll and pitch (+ nose up) of STAB; both sticks share MPC_MAN_TILT_MAX."""
    scale = math.radians(params["MPC_MAN_TILT_MAX"]) / max(1.0, length(sticks.lean))
    return sticks.right * scale, -sticks.forward * scale


def speed_mps(sticks: Px4Sticks, params: Px4Params) -> complex:
    """Return POSCTL's final speed, forward + 1j * right; both sticks share MPC_VEL_MANUAL."""
    deflection = length(sticks.lean)
    if deflection == 0.0:
        return 0j
    speed = params["MPC_VEL_MANUAL"] * curve(min(1.0, deflection), params.dead_zone)
    return speed * sticks.lean / deflection


def manual_thrust(sticks: Px4Sticks, params: Px4Params, hover: float) -> float:
    """Return the collective of STAB: two lines that meet at hover thrust, mid-stick."""
    if sticks.throttle < 0.0:
        least = params["MPC_MANTHR_MIN"]
        return least + (1.0 + sticks.throttle) * (hover - least)
    return hover + sticks.throttle * (params["MPC_THR_MAX"] - hover)
