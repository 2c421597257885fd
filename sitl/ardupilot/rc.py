"""Radio: receiver and overrides, merged channel by channel, switches, and what the sticks mean.

Formulas: ArduPilot ``RC_Channel`` (calibration), Copter ``get_pilot_desired_throttle`` and
``get_pilot_desired_climb_rate``; checked against leans and rates measured on the firmware.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from sitl.ardupilot.params import RC_CHANNELS_WITH_PARAMS, ArduPilotParams
from sitl.clock import NS_PER_S
from sitl.vehicle.firmware import Receiver

STICKS = ("ROLL", "PITCH", "THROTTLE", "YAW")
CHANNELS = 16
OVERRIDDEN_CHANNELS = 8  # overrides of channels 9-16 are ignored
IGNORE = 65535
RELEASE = 0

DEBOUNCE_NS = NS_PER_S // 5
_OPTION_OVERRIDE_SWITCH = 46
_SWITCH_PERIOD_NS = NS_PER_S // 10
"""Period of reading the override switch: a flip acts after 0.2 to 0.3 s (measured: 0.38 s)."""
_OPTIONS_IGNORE_RECEIVER = 1
_OPTIONS_IGNORE_OVERRIDES = 2


class RcEngine:
    """Merges receiver and overrides, channel by channel. Stamps are nanoseconds of one clock.

    Rules as measured on ArduCopter 4.7: each channel expires after RC_OVERRIDE_TIME, ranges are not
    checked, and without a receiver the sticks stay latched.
    """

    def __init__(self, params: ArduPilotParams, receiver: Receiver) -> None:
        self._params = params
        mapped = {axis: params.integer(f"RCMAP_{axis}") for axis in STICKS}
        self._indices = {n: min(max(c, 1), RC_CHANNELS_WITH_PARAMS) - 1 for n, c in mapped.items()}
        self._receiver = receiver
        self._override_us = [RELEASE] * CHANNELS
        self._override_ns = [0] * CHANNELS
        self._fresh_override = self._was_overridden = False
        self._switch = 0  # RCn_OPTION 46: 1 high, -1 low
        self._switch_since_ns = self._switch_due_ns = 0
        self._takes_overrides = True
        self.channels_us = [0] * CHANNELS
        """Channels that RC_CHANNELS reports and the modes use; 0 = never had a value."""

    @property
    def found(self) -> bool:
        """True if there is a receiver, or an override has come."""
        return self._was_overridden or self._receiver.channels_us is not None

    @property
    def channel_count(self) -> int:
        return max(OVERRIDDEN_CHANNELS, len(self._receiver.channels_us or ()))

    def override(self, raw_us: Sequence[int], now_ns: int) -> None:
        """Apply one RC_CHANNELS_OVERRIDE."""
        if not self._takes_overrides:
            return
        for index, value in enumerate(raw_us[:OVERRIDDEN_CHANNELS]):
            if value != IGNORE:
                self._override_us[index] = value
                self._override_ns[index] = now_ns
                self._fresh_override = self._was_overridden = True

    def manual_control(self, *, x: int, y: int, z: int, r: int, now_ns: int) -> None:
        """Override the sticks by a joystick: -1000..1000, z 0..1000; +x is forward, a lower PWM."""
        raw_us = [IGNORE] * OVERRIDDEN_CHANNELS
        for axis, share in zip(STICKS, (y + 1000, 1000 - x, 2 * z, r + 1000), strict=True):
            index = self.index_of(axis)
            low, high = (self._params.integer(f"RC{index + 1}_{end}") for end in ("MIN", "MAX"))
            raw_us[index] = low + (high - low) * share // 2000
        self.override(raw_us, now_ns)

    def index_of(self, axis: str) -> int:
        """Return the zero-based channel of one of ``STICKS``, by RCMAP_* at boot."""
        return self._indices[axis]

    def sticks_us(self) -> tuple[int, int, int, int]:
        """Return the roll, pitch, throttle and yaw that the modes use [us], by RCMAP_*."""
        roll, pitch, throttle, yaw = (self.channels_us[self.index_of(axis)] for axis in STICKS)
        return roll, pitch, throttle, yaw

    def update(self, now_ns: int) -> bool:
        """Refresh ``channels_us``. Return True if receiver or overrides supplied a value."""
        values: list[int | None] = []
        if self._receiver.frame(now_ns) is not None or self._fresh_override:
            self._fresh_override = False
            values = [self._source(index, now_ns) for index in range(CHANNELS)]
            for index, value in enumerate(values):
                if value is not None:
                    self.channels_us[index] = value
        self._watch_switch(now_ns)
        return any(value is not None for value in values)

    def _source(self, index: int, now_ns: int) -> int | None:
        options = self._params.integer("RC_OPTIONS")
        lifetime_s = self._params["RC_OVERRIDE_TIME"]
        age_ns = now_ns - self._override_ns[index]
        is_alive = lifetime_s < 0.0 or age_ns < lifetime_s * NS_PER_S
        is_allowed = is_alive and not options & _OPTIONS_IGNORE_OVERRIDES
        if self._override_us[index] != RELEASE and is_allowed:
            return self._override_us[index]
        receiver_us = self._receiver.channels_us
        if receiver_us is None or options & _OPTIONS_IGNORE_RECEIVER:
            return None
        return receiver_us[index] if index < len(receiver_us) else 0

    def _watch_switch(self, now_ns: int) -> None:
        """Read the override switch: high allows overrides, low forbids them, the middle changes
        nothing."""
        numbers = range(1, RC_CHANNELS_WITH_PARAMS + 1)
        option = _OPTION_OVERRIDE_SWITCH
        switches = [n for n in numbers if self._params.integer(f"RC{n}_OPTION") == option]
        if not switches or now_ns < self._switch_due_ns:
            return
        self._switch_due_ns = now_ns + _SWITCH_PERIOD_NS
        pwm_us = self.channels_us[switches[0] - 1]
        side = (1800 < pwm_us < 2200) - (900 < pwm_us < 1200)
        if side != self._switch:
            self._switch, self._switch_since_ns = side, now_ns
        if side and now_ns - self._switch_since_ns >= DEBOUNCE_NS:
            self._takes_overrides = side > 0
            if not self._takes_overrides:
                self._override_us = [RELEASE] * CHANNELS


THROTTLE_FULL = 1000.0


class Sticks(NamedTuple):
    """Stick positions after calibration and dead zone."""

    roll: float  # [-1, 1], + right
    pitch: float  # [-1, 1], + stick back, nose up: the sign of the raw channel, not of a joystick
    yaw: float  # [-1, 1], + nose right
    throttle: float  # [0, 1000] from stick down to stick up
    throttle_mid: float  # middle of the throttle's travel on that scale


def read_sticks(rc: RcEngine, params: ArduPilotParams) -> Sticks:
    """Return the four flight sticks by RCMAP_*; a channel that never had a value is centred."""
    throttle, mid = _throttle(rc, params)
    return Sticks(
        roll=_centred(rc, params, "ROLL"),
        pitch=_centred(rc, params, "PITCH"),
        yaw=_centred(rc, params, "YAW"),
        throttle=throttle,
        throttle_mid=mid,
    )


def _centred(rc: RcEngine, params: ArduPilotParams, axis: str) -> float:
    index = rc.index_of(axis)
    pwm = rc.channels_us[index]
    name = f"RC{index + 1}_"
    trim, dead_zone = params[name + "TRIM"], params[name + "DZ"]
    beyond = abs(pwm - trim) - dead_zone
    if pwm == 0 or beyond <= 0.0:
        return 0.0
    travel = params[name + "MAX"] - trim if pwm > trim else trim - params[name + "MIN"]
    share = min(1.0, beyond / (travel - dead_zone)) if travel > dead_zone else 0.0
    return math.copysign(share, (trim - pwm) if params[name + "REVERSED"] else (pwm - trim))


def _throttle(rc: RcEngine, params: ArduPilotParams) -> tuple[float, float]:
    """Return the throttle and its middle, in 0..THROTTLE_FULL."""
    index = rc.index_of("THROTTLE")
    name = f"RC{index + 1}_"
    low, high = params[name + "MIN"], params[name + "MAX"]
    bottom = low + params[name + "DZ"]
    if high <= bottom:
        return 0.0, THROTTLE_FULL / 2.0
    scale = THROTTLE_FULL / (high - bottom)
    mid = max(0.0, ((low + high) / 2.0 - bottom) * scale)
    if rc.channels_us[index] == 0:
        return 0.0, mid
    pwm = max(low, min(high, float(rc.channels_us[index])))
    if params[name + "REVERSED"]:
        pwm = low + high - pwm
    return max(0.0, (pwm - bottom) * scale), mid


def lean_angles(sticks: Sticks, params: ArduPilotParams) -> tuple[float, float]:
    """Return roll and pitch [rad] (+ right, + nose up), their joint length limited to ANGLE_MAX."""
    limit = math.radians(params["ANGLE_MAX"] / 100.0)
    scale = limit / max(1.0, math.hypot(sticks.roll, sticks.pitch))
    return sticks.roll * scale, sticks.pitch * scale


def yaw_rate_radps(sticks: Sticks, params: ArduPilotParams) -> float:
    """Return the yaw rate; ``input_expo`` is softer around the middle, unchanged at the ends."""
    expo = max(0.0, min(0.95, params["PILOT_Y_EXPO"]))
    share = (1.0 - expo) * sticks.yaw / (1.0 - expo * abs(sticks.yaw))
    return math.radians(params["PILOT_Y_RATE"]) * share


def climb_rate_mps(sticks: Sticks, params: ArduPilotParams) -> float:
    """Return the climb rate of ALT_HOLD, + up; 0 within THR_DZ of the middle."""
    dead_zone = max(0.0, min(400.0, params["THR_DZ"]))
    top = sticks.throttle_mid + dead_zone
    bottom = sticks.throttle_mid - dead_zone
    up = params["PILOT_SPEED_UP"] / 100.0
    if sticks.throttle > top:
        return up * (sticks.throttle - top) / (THROTTLE_FULL - top)
    if sticks.throttle < bottom:
        return (params["PILOT_SPEED_DN"] / 100.0 or up) * (sticks.throttle - bottom) / bottom
    return 0.0


def manual_thrust(sticks: Sticks, params: ArduPilotParams) -> float:
    """Return the collective in [0, 1] of STABILIZE, with hover thrust at mid-stick."""
    mid = min(max(sticks.throttle_mid, 1.0), THROTTLE_FULL - 1.0)
    if sticks.throttle < mid:
        position = 0.5 * sticks.throttle / mid
    else:
        position = 0.5 + 0.5 * (sticks.throttle - mid) / (THROTTLE_FULL - mid)
    expo = max(-0.5, min(1.0, (0.5 - params["MOT_THST_HOVER"]) / 0.375))
    return max(0.0, min(1.0, position * (1.0 - expo) + expo * position**3))
