"""Parameters of ArduCopter that matter for a flight: calibration, obstacles and risks."""

from collections.abc import Iterator, Mapping

from mavbridge.core.reasons import Code, because
from mavbridge.mavlink.codec.calibration import (
    DEAD_ZONE_US,
    FS_THR_MARGIN_US,
    RcCalibration,
    RcChannel,
)
from mavbridge.mavlink.profiles.profile import (
    Danger,
    ParamContext,
    ParamNote,
    StickSetting,
    WantedParam,
    stick_obstacles,
)

STICKS = ("THROTTLE", "YAW", "PITCH", "ROLL")
"""RCMAP_* suffixes in the order of ``Sticks``."""
_OPTION_CHANNELS = range(5, 17)
"""Channels of a radio's switches; by default the first four carry the sticks."""
_CALIBRATION_PARTS = ("MIN", "TRIM", "MAX", "REVERSED")
_OVERRIDE_SWITCH_OPTION = 46
"""RCn_OPTION "RC Override Enable": overrides are refused while the switch is low."""
IGNORE_RECEIVER, _IGNORE_OVERRIDES = 1, 2
"""Bits 0 and 1 of RC_OPTIONS."""
SIMPLE_NAMES = ("SIMPLE", "SUPER_SIMPLE")
_SIMPLE_OPTIONS = (3.0, 13.0)
"""RCn_OPTION "Simple Mode" and "Super Simple Mode"."""
_TURNED = "pitch and roll sticks count in the axes of "
_THRUST_AS_THRUST = 8
"""Bit 3 of GUID_OPTIONS; without it, thrust in SET_ATTITUDE_TARGET is a climb rate."""
_CONTINUE_LANDING = 8
"""Bit 3 of FS_OPTIONS."""
_LONGEST_S = 1.0
"""Longest useful timeout; a longer one leaves the vehicle uncontrolled longer than necessary."""

_OLD_NAMES = {
    "MAV_GCS_SYSID": "SYSID_MYGCS",
    "ATC_ANGLE_MAX": "ANGLE_MAX",
    "PILOT_SPD_UP": "PILOT_SPEED_UP",
    "PILOT_SPD_DN": "PILOT_SPEED_DN",
}
"""Names since 4.7, with those up to 4.6."""

RISK_NAMES = ("RC_OVERRIDE_TIME", "RC_OPTIONS", "FS_THR_ENABLE")
"""Parameters that decide a flight's safety: requested again if the first requests get lost."""

FIRST_NAMES = (
    *(f"RCMAP_{stick}" for stick in STICKS),
    *RISK_NAMES,
    "FLTMODE_CH",
    *("RC_FS_TIMEOUT", "FS_THR_VALUE", "FS_OPTIONS", "THR_DZ", "MAV_GCS_SYSID_HI"),
    *("GUID_OPTIONS", "GUID_TIMEOUT", "ATC_ANGLE_BOOST", "MOT_THST_HOVER"),
    *("PILOT_Y_RATE", "PILOT_Y_EXPO"),
    *_OLD_NAMES,
    *_OLD_NAMES.values(),
    *(f"RC{number}_OPTION" for number in _OPTION_CHANNELS),
)
"""Parameters to read first; RCMAP_* then selects the RCn_MIN etc. to read."""


def calibration_names(values: Mapping[str, float]) -> tuple[str, ...]:
    """Return the parameters needed to map sticks to channels, as far as RCMAP_* is known."""
    names = tuple(f"RCMAP_{stick}" for stick in STICKS)
    numbers = sorted({int(values[name]) for name in names if name in values})
    return names + tuple(f"RC{number}_{part}" for number in numbers for part in _CALIBRATION_PARTS)


def dead_zone_names(values: Mapping[str, float]) -> tuple[str, ...]:
    """Return RCn_DZ of the stick channels, as far as RCMAP_* is known."""
    known = (values.get(f"RCMAP_{stick}") for stick in STICKS)
    return tuple(f"RC{int(number)}_DZ" for number in known if number is not None)


def stick_setting_names(values: Mapping[str, float]) -> tuple[str, ...]:
    """Return the names in ``stick_settings`` not read first, as far as RCMAP_* is known."""
    names = (each.name for each in stick_settings(values))
    return tuple(name for name in names if name not in FIRST_NAMES)


def calibration(values: Mapping[str, float]) -> RcCalibration:
    """Return the radio calibration. Raise ValueError if parameters are missing or contradictory."""
    throttle, yaw, pitch, roll = (
        _channel(values, int(_require(values, f"RCMAP_{stick}"))) for stick in STICKS
    )
    floor_us = int(values.get("FS_THR_VALUE", 0)) + FS_THR_MARGIN_US
    return RcCalibration(
        throttle=throttle, yaw=yaw, pitch=pitch, roll=roll, throttle_floor_us=floor_us
    )


def _channel(values: Mapping[str, float], number: int) -> RcChannel:
    return RcChannel(
        number=number,
        min_us=int(_require(values, f"RC{number}_MIN")),
        trim_us=int(_require(values, f"RC{number}_TRIM")),
        max_us=int(_require(values, f"RC{number}_MAX")),
        is_reversed=bool(_require(values, f"RC{number}_REVERSED")),
        dead_zone_us=int(values.get(f"RC{number}_DZ", DEAD_ZONE_US)),
    )


def _require(values: Mapping[str, float], name: str) -> float:
    if name not in values:
        raise ValueError(
            f"the vehicle has not sent parameter {name}, which is asked for again; does it have RC "
            "input?"
        )
    return values[name]


def override_switch(values: Mapping[str, float]) -> int | None:
    """Return the number of the channel that enables overrides, or None."""
    options = {number: values.get(f"RC{number}_OPTION") for number in _OPTION_CHANNELS}
    return next((n for n, option in options.items() if option == _OVERRIDE_SWITCH_OPTION), None)


def stick_settings(values: Mapping[str, float]) -> Iterator[StickSetting]:
    """Yield parameters that can turn our sticks, or let them operate a switch.

    The bits of SIMPLE_NAMES belong to positions of the pilot's mode switch, which may move at any
    time. Simple mode turns by the heading at arming, which is not reported and so cannot be mapped.
    """
    yield StickSetting("SIMPLE", f"{_TURNED}the heading at arming", lambda bits: bits == 0, 0)
    yield StickSetting("SUPER_SIMPLE", f"{_TURNED}the way home", lambda bits: bits == 0, 0)
    sticks = {values[name]: name for name in map("RCMAP_{}".format, STICKS) if name in values}
    for number in sorted({*_OPTION_CHANNELS, *map(int, sticks)}):
        name = f"RC{number}_OPTION"
        if number in sticks:
            effect = f"the stick of {sticks[number]} would work a switch"
            yield StickSetting(name, effect, lambda option: option == 0, 0)
        else:
            effect = f"with that switch, {_TURNED}the heading at arming or of the way home"
            yield StickSetting(name, effect, lambda option: option not in _SIMPLE_OPTIONS, 0)
    channel = values.get("FLTMODE_CH", 0)
    yield StickSetting(
        "FLTMODE_CH",
        f"the stick of {sticks.get(channel)} would change the flight mode",
        lambda number: number not in sticks,
        next((number for number in range(5, 9) if number not in sticks), 0),
    )


def is_simple_setting(name: str, value: float) -> bool:
    """True if this parameter can put the vehicle into Simple mode."""
    is_option = name.endswith("_OPTION") and value in _SIMPLE_OPTIONS
    return is_option or (name in SIMPLE_NAMES and value != 0)


def override_obstacles(values: Mapping[str, float], source_system: int) -> Iterator[ParamNote]:
    """Yield settings under which this vehicle would ignore our overrides."""
    low = values.get("MAV_GCS_SYSID", values.get("SYSID_MYGCS"))
    if low is not None:
        high = max(values.get("MAV_GCS_SYSID_HI", 0), low)
        if not low <= source_system <= high:
            yield ParamNote(
                ("MAV_GCS_SYSID", "SYSID_MYGCS"),
                f"it obeys system {low:.0f} and we are system {source_system}",
                f"--set-config link.source_system={low:.0f}",
                ", or set MAV_GCS_SYSID (SYSID_MYGCS on older firmware)",
            )
    options = int(values.get("RC_OPTIONS", 0))
    if options & _IGNORE_OVERRIDES:
        yield ParamNote(
            ("RC_OPTIONS",),
            "RC_OPTIONS bit 1 (ignore overrides) is set",
            f"--set RC_OPTIONS={options & ~_IGNORE_OVERRIDES}",
        )
    if values.get("RC_OVERRIDE_TIME") == 0:
        yield ParamNote(
            ("RC_OVERRIDE_TIME",),
            "RC_OVERRIDE_TIME is 0, which disables overrides",
            "--set RC_OVERRIDE_TIME=0.5",
        )
    yield from stick_obstacles(stick_settings(values), values)


def thrust_obstacles(values: Mapping[str, float]) -> Iterator[ParamNote]:
    """Yield settings under which the thrust of SET_ATTITUDE_TARGET would not act as thrust."""
    options = values.get("GUID_OPTIONS")
    if options is None:
        yield ParamNote(("GUID_OPTIONS",), "it has not sent GUID_OPTIONS, which is asked for again")
    elif not int(options) & _THRUST_AS_THRUST:
        yield ParamNote(
            ("GUID_OPTIONS",),
            f"GUID_OPTIONS is {options:g}, with which it takes our thrust for a climb rate",
            f"--set GUID_OPTIONS={int(options) | _THRUST_AS_THRUST}",
        )


def override_dangers(values: Mapping[str, float], *, has_receiver: bool | None) -> Iterator[Danger]:
    """Yield settings under which the last sticks would stay for ever if this computer died."""
    time_s = values.get("RC_OVERRIDE_TIME")
    if time_s is not None and time_s < 0:
        why = because(Code.ENDLESS_OVERRIDE, time_s=time_s)
        yield Danger("endless-override", why, "RC_OVERRIDE_TIME", "--set RC_OVERRIDE_TIME=0.5")
    if values.get("FS_THR_ENABLE") == 0 and has_receiver is not True:
        why = because(Code.NO_THROTTLE_FAILSAFE)
        yield Danger("no-throttle-failsafe", why, "FS_THR_ENABLE", "--set FS_THR_ENABLE=1")


def override_advice(values: Mapping[str, float]) -> Iterator[ParamNote]:
    """Yield warnings before a flight by overrides."""
    missing = [name for name in RISK_NAMES if name not in values]
    if missing:
        yield ParamNote(
            tuple(missing),
            f"the vehicle has not sent {', '.join(missing)}: whether it holds its last sticks for "
            "ever if this computer dies is not known",
        )
    if missing := [name for name in SIMPLE_NAMES if name not in values]:
        yield ParamNote(
            tuple(missing),
            f"the vehicle has not sent {', '.join(missing)}: whether {_TURNED}the heading at "
            "arming is not known",
        )
    time_s = values.get("RC_OVERRIDE_TIME", 0.0)
    if time_s > _LONGEST_S:
        yield ParamNote(
            ("RC_OVERRIDE_TIME",),
            f"RC_OVERRIDE_TIME is {time_s:g}: if this computer died, the vehicle would hold its "
            "last sticks for that many seconds",
            "--set RC_OVERRIDE_TIME=0.5",
        )


def setpoint_advice(values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
    """Yield warnings before a flight by setpoints in GUIDED."""
    timeout_s = values.get("GUID_TIMEOUT", 0.0)
    if timeout_s > _LONGEST_S:
        yield ParamNote(
            ("GUID_TIMEOUT",),
            f"GUID_TIMEOUT is {timeout_s:g}: if this computer died, the vehicle would hold its "
            "last setpoint for that many seconds",
            "--set GUID_TIMEOUT=0.5",
        )
    if context.has_receiver is False and values.get("FS_THR_ENABLE", 0.0) != 0:
        yield ParamNote(
            ("FS_THR_ENABLE",),
            "no receiver was seen: the vehicle will not arm without one while its throttle "
            "failsafe is on; setpoints do not need it",
            "--set FS_THR_ENABLE=0",
        )
    if context.output == "attitude" and values.get("ATC_ANGLE_BOOST") == 0:
        yield ParamNote(
            ("ATC_ANGLE_BOOST",),
            "ATC_ANGLE_BOOST is 0: thrust is not raised when it leans, the policy has to do it",
        )


def hints(values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
    """Yield failsafes and switches that make a flight safer."""
    if context.output != "rc-override":
        return
    options = values.get("FS_OPTIONS")
    lands_on = options is None or int(options) & _CONTINUE_LANDING
    if context.has_receiver is False and options is not None and not lands_on:
        yield ParamNote(
            ("FS_OPTIONS",),
            f"FS_OPTIONS is {options:g}: without a receiver, a landing turns into RTL when the "
            "sticks end",
            f"--set FS_OPTIONS={int(options) | _CONTINUE_LANDING}",
        )
    if context.has_receiver and override_switch(values) is None:
        yield ParamNote(
            ("RCn_OPTION",),
            "no RCn_OPTION is 46: a switch of the radio with it takes the sticks back in the "
            "autopilot itself, whatever happens here",
        )


def wanted_params(values: Mapping[str, float], context: ParamContext) -> Iterator[WantedParam]:
    """Yield the parameters for overrides, or for setpoints, under this firmware's names."""
    if context.output == "rc-override":
        name = "SYSID_MYGCS" if "SYSID_MYGCS" in values else "MAV_GCS_SYSID"
        yield WantedParam(name, f"{context.source_system}, our system id")
        yield WantedParam("RC_OPTIONS", "bit 1 clear")
        yield WantedParam("RC_OVERRIDE_TIME", f"0.5; above 0, at most {_LONGEST_S:g} s")
        for name in SIMPLE_NAMES:
            yield WantedParam(name, "0")
        receiver = "" if context.has_receiver else ", without a receiver"
        yield WantedParam("FS_THR_ENABLE", f"not 0{receiver}")
        yield WantedParam("FS_OPTIONS", "any" if context.has_receiver else "24 (bit 3 set)")
        if (switch := override_switch(values)) is not None:
            yield WantedParam(f"RC{switch}_OPTION", "46, with its switch on")
        return
    yield WantedParam("GUID_TIMEOUT", f"0.5; at most {_LONGEST_S:g} s")
    yield WantedParam("FS_THR_ENABLE", "not 0" if context.has_receiver else "0")
    if context.output in ("attitude", "rates"):
        yield WantedParam("GUID_OPTIONS", "bit 3 (8) set")
        boost = "1, or as in training" if context.output == "attitude" else "any"
        yield WantedParam("ATC_ANGLE_BOOST", boost)
