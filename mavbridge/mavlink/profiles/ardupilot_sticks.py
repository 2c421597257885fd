"""Radio calibration and sticks of ArduCopter: their motion, and what turns them.

Formulas: ArduPilot's ``RC_Channel::norm_input_dz``, ``rc_input_to_roll_pitch``, ``input_expo`` and
Copter's ``get_pilot_desired_yaw_rate`` and ``get_pilot_desired_climb_rate``. The tests compare them
with leans and rates measured on the firmware.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from mavbridge.core.vehicle import StickGains
from mavbridge.mavlink.codec.calibration import (
    FS_THR_MARGIN_US,
    PWM_SIGN,
    RcCalibration,
    RcChannel,
)
from mavbridge.mavlink.profiles.profile import ParamNote
from mavbridge.mavlink.profiles.sticks import (
    IDENTITY,
    MAX_DEAD_ZONE,
    Axis,
    Half,
    Lean,
    StickCurves,
    curves_between,
    unusable,
)

STICKS = ("THROTTLE", "YAW", "PITCH", "ROLL")
"""RCMAP_* suffixes in the order of ``Sticks``."""
OPTION_CHANNELS = range(1, 17)
"""Channels of a radio, which may all carry a switch where no stick is."""
SIMPLE_NAMES = ("SIMPLE", "SUPER_SIMPLE")
_SIMPLE_OPTIONS = (3.0, 13.0)
"""RCn_OPTION "Simple Mode" and "Super Simple Mode"."""
TURNED = "pitch and roll sticks count in the axes of "
_STICK_PARTS = ("MIN", "TRIM", "MAX", "REVERSED", "DZ")
_LEAN_MODES = ("ALT_HOLD", "STABILIZE")
"""Modes in which sticks are a lean and a yaw rate."""
_CLIMB_MODE = "ALT_HOLD"
_MAX_LEAN_DEG = 85.0
"""Firmware limits: ``_MAX_LEAN_DEG``, ``_MAX_THR_DZ``, ``_MIN_EXPO`` and ``_MAX_EXPO``."""
_MAX_THR_DZ = 400.0
_MIN_EXPO, _MAX_EXPO = -0.5, 0.95


class YawExpo(NamedTuple):
    """ArduPilot's ``input_expo``; a positive ``expo`` is softer around the middle."""

    expo: float

    def bent(self, share: float) -> float:
        """Return the fraction of the yaw rate at this fraction of the stick."""
        return (1.0 - self.expo) * share / (1.0 - self.expo * share)

    def straightened(self, share: float) -> float:
        """Return the fraction of the stick for this fraction of the yaw rate."""
        return share / (1.0 - self.expo + self.expo * share)


def ardupilot_curves(
    values: Mapping[str, float], mode: str, gains: StickGains | None
) -> StickCurves:
    """Return the map from the policy's sticks to those of an ArduCopter with these parameters.

    ALT_HOLD maps all sticks, STABILIZE all but the throttle, which is thrust there. In other modes
    sticks have meanings that ``gains`` does not cover (a speed in LOITER and POSHOLD, a body rate
    in ACRO and SPORT, both in DRIFT) and stay unchanged; all stay unchanged if ``gains`` is None.
    """
    if gains is None or mode not in _LEAN_MODES:
        return IDENTITY
    lean = _present(values, "ATC_ANGLE_MAX", "ANGLE_MAX")
    up = _present(values, "PILOT_SPD_UP", "PILOT_SPEED_UP")
    down = _present(values, "PILOT_SPD_DN", "PILOT_SPEED_DN")
    needed = (lean, "PILOT_Y_RATE", up, down, "THR_DZ", *stick_names(values))
    if (
        nothing := unusable(values, needed=needed, positive=(lean, "PILOT_Y_RATE", up))
    ) is not None:
        return nothing
    full_deg = min(values[lean] * (0.01 if lean == "ANGLE_MAX" else 1.0), _MAX_LEAN_DEG)
    expo = values.get("PILOT_Y_EXPO", 0.0)
    bend = YawExpo(max(expo, _MIN_EXPO)) if expo and expo < _MAX_EXPO else None
    yaw = Half(values["PILOT_Y_RATE"], bend=bend, parameter="PILOT_Y_RATE")
    return curves_between(
        gains,
        throttle=_throttle(values, up, down) if mode == _CLIMB_MODE else None,
        yaw=_centred(values, "YAW", yaw, PWM_SIGN.yaw),
        lean=Lean(
            pitch=_centred(values, "PITCH", Half(full_deg), PWM_SIGN.pitch),
            roll=_centred(values, "ROLL", Half(full_deg), PWM_SIGN.roll),
            full=full_deg,
            parameter=lean,
        ),
    )


def _present(values: Mapping[str, float], new: str, old: str) -> str:
    """Return the name that this firmware has sent; the old one if it has sent neither."""
    return new if new in values else old


def _centred(values: Mapping[str, float], stick: str, half: Half, sign: float) -> Axis:
    """Return the axis of a stick around RCn_TRIM, with a dead zone of RCn_DZ [us] to each side."""
    name = f"RC{int(values[f'RCMAP_{stick}'])}_"
    trim_us, dead_us = values[name + "TRIM"], values[name + "DZ"]

    def started(span_us: float) -> Half:
        share = dead_us / span_us if span_us > 0.0 else 0.0
        return half._replace(start=min(max(share, 0.0), MAX_DEAD_ZONE))

    high, low = started(values[name + "MAX"] - trim_us), started(trim_us - values[name + "MIN"])
    is_high = (sign > 0.0) != bool(values[name + "REVERSED"])
    return Axis(high, low) if is_high else Axis(low, high)


def _throttle(values: Mapping[str, float], up: str, down: str) -> Axis:
    """Return the climb-rate axis: dead zones THR_DZ [permille] (middle), RC3_DZ [us] (bottom)."""
    name = f"RC{int(values['RCMAP_THROTTLE'])}_"
    range_us = values[name + "MAX"] - values[name + "MIN"]
    lost = min(max(values[name + "DZ"] / range_us, 0.0), 0.4) if range_us > 0.0 else 0.0
    dead_zone = min(max(values["THR_DZ"], 0.0), _MAX_THR_DZ) / 1000.0
    # The firmware counts from the end of the lost part to the top, the stick from the middle.
    start, end = 2.0 * (1.0 - lost) * dead_zone, 1.0 - 2.0 * lost
    start = min(start, MAX_DEAD_ZONE * end)
    climb_mps = values[up] * (0.01 if up == "PILOT_SPEED_UP" else 1.0)
    descent_mps = abs(values[down]) * (0.01 if down == "PILOT_SPEED_DN" else 1.0)
    return Axis(
        Half(climb_mps, start, parameter=up),
        Half(descent_mps or climb_mps, start, end, parameter=down if descent_mps else up),
    )


def stick_names(values: Mapping[str, float], *parts: str) -> tuple[str, ...]:
    """Return the parameters that map sticks to channels, as far as RCMAP_* is known.

    ``parts``: more suffixes of RCn_ for each of these channels.
    """
    names = tuple(f"RCMAP_{stick}" for stick in STICKS)
    numbers = sorted({int(values[name]) for name in names if name in values})
    suffixes = (*_STICK_PARTS, *parts)
    return names + tuple(f"RC{number}_{suffix}" for number in numbers for suffix in suffixes)


def calibration(values: Mapping[str, float]) -> RcCalibration:
    """Return the radio calibration. Raise ValueError if parameters are missing or contradictory."""
    throttle, yaw, pitch, roll = (_channel(values, f"RCMAP_{stick}") for stick in STICKS)
    floor_us = int(values.get("FS_THR_VALUE", 0)) + FS_THR_MARGIN_US
    return RcCalibration(
        throttle=throttle, yaw=yaw, pitch=pitch, roll=roll, throttle_floor_us=floor_us
    )


def _channel(values: Mapping[str, float], stick: str) -> RcChannel:
    number = int(_require(values, stick))
    if number not in range(1, 9):
        raise ValueError(
            f"{stick} is {number}, and sticks go to channels 1 to 8: set it, and reboot the vehicle"
        )
    return RcChannel(
        number=number,
        min_us=int(_require(values, f"RC{number}_MIN")),
        trim_us=int(_require(values, f"RC{number}_TRIM")),
        max_us=int(_require(values, f"RC{number}_MAX")),
        is_reversed=bool(_require(values, f"RC{number}_REVERSED")),
    )


def _require(values: Mapping[str, float], name: str) -> float:
    if name not in values:
        raise ValueError(
            f"the vehicle has not sent parameter {name}, which is asked for again; does it have RC "
            "input, and answer anything (mavbridge check)?"
        )
    return values[name]


def map_notes(values: Mapping[str, float], booted: Mapping[str, float]) -> Iterator[ParamNote]:
    """Yield RCMAP_* that have changed since they were first read: they count from the next boot."""
    for stick in filter(values.get, map("RCMAP_{}".format, STICKS)):
        if (old := booted.get(stick, values[stick])) != values[stick]:
            effect = f", and it goes on with {old:g} until its next boot: reboot it"
            yield ParamNote.of("obstacle", stick, values[stick], effect)


def stick_notes(values: Mapping[str, float]) -> Iterator[ParamNote]:
    """Yield parameters that turn our sticks, or let them operate a switch.

    The bits of SIMPLE_NAMES belong to positions of the pilot's mode switch, which may move at any
    time. Simple mode turns by the heading at arming, which is not reported and so cannot be mapped.
    """
    for name, turned_by in zip(SIMPLE_NAMES, ("heading at arming", "way home"), strict=True):
        yield ParamNote("wanted", (name,), "0")
        if bits := values.get(name, 0):
            note = ParamNote.of("obstacle", name, bits, f": {TURNED}the {turned_by}", 0)
            yield note._replace(turns_sticks=True)
    sticks = {values[name]: name for name in map("RCMAP_{}".format, STICKS) if name in values}
    for number in sorted({*OPTION_CHANNELS, *map(int, sticks)}):
        option = values.get(name := f"RC{number}_OPTION", 0)
        if option and number in sticks:
            effect = f": the stick of {sticks[number]} would work a switch"
            yield ParamNote.of("obstacle", name, option, effect, 0)
        elif option in _SIMPLE_OPTIONS:
            effect = f": with that switch, {TURNED}the heading at arming or of the way home"
            yield ParamNote.of("obstacle", name, option, effect, 0)._replace(turns_sticks=True)
    for number, stick in sticks.items():
        low, trim, high, dead = (
            values.get(f"RC{number:g}_{part}", 0.0) for part in ("MIN", "TRIM", "MAX", "DZ")
        )
        shorter_us = min(trim - low, high - trim)
        if stick != "RCMAP_THROTTLE" and low < high and 0 <= shorter_us <= dead:
            name = f"RC{number:g}"
            said = f"{name} goes from {low:g} to {high:g} us around {trim:g}, and its dead zone of "
            said += f"{dead:g} us hides one half of the stick of {stick}: calibrate the radio"
            yield ParamNote("obstacle", (f"{name}_DZ", f"{name}_TRIM"), said)
    if (channel := values.get("FLTMODE_CH")) in sticks:
        effect = f": the stick of {sticks[channel]} would change the flight mode"
        free = next((number for number in range(5, 9) if number not in sticks), 0)
        yield ParamNote.of("obstacle", "FLTMODE_CH", channel, effect, free)


def takeoff_notes(values: Mapping[str, float]) -> Iterator[ParamNote]:
    """Yield the height, up to 10 m, to which the first climb by the throttle goes by itself."""
    for name in ("PILOT_TKO_ALT_M", "PILOT_TKOFF_ALT"):
        if height := values.get(name, 0):
            effect = ": a takeoff by the throttle goes on to that height by itself"
            yield ParamNote.of("advice", name, height, effect, 0)


def is_simple_setting(name: str, value: float) -> bool:
    """True if this parameter can put the vehicle into Simple mode."""
    is_option = name.endswith("_OPTION") and value in _SIMPLE_OPTIONS
    return is_option or (name in SIMPLE_NAMES and value != 0)
