"""The meaning of a vehicle's parameters for a flight: radio calibration, obstacles and risks."""

from collections.abc import Container, Iterator, Mapping
from typing import NamedTuple

from mavbridge.core.vehicle import Risk
from mavbridge.mavlink.codec.calibration import (
    DEAD_ZONE_US,
    FS_THR_MARGIN_US,
    RcCalibration,
    RcChannel,
)
from mavbridge.mavlink.session.params.reader import OPTION_CHANNELS, RISK_NAMES, STICKS

OVERRIDE_SWITCH_OPTION = 46
"""RCn_OPTION "RC Override Enable": while the switch is low, all overrides are refused."""
_IGNORE_OVERRIDES = 2
"""Bit 1 of RC_OPTIONS."""
_LONGEST_S = 1.0
"""A longer RC_OVERRIDE_TIME leaves the vehicle without a pilot for longer than necessary."""


class Danger(NamedTuple):
    """A setting with which the vehicle flies, but is not safe."""

    risk: Risk
    text: str

    @property
    def refusal(self) -> str:
        """The sentence for a flight that is not begun."""
        return f"{self.text}, or --accept-risk {self.risk} to fly all the same"


class Assessment(NamedTuple):
    """One set of parameters, judged."""

    calibration: RcCalibration | None
    unusable: str | None
    """Why there is no calibration."""
    override_switch: int | None
    """Number of the channel that enables overrides."""
    obstacles: tuple[str, ...]
    """Reasons for which the vehicle would ignore our overrides."""
    dangers: tuple[Danger, ...]
    """Accepted ones included."""

    def endangers(self, before: "Assessment", *, accepted: Container[Risk]) -> bool:
        """True if this set of parameters must end a flight that was begun with the other."""
        new_risks = {danger.risk for danger in self.dangers} - {d.risk for d in before.dangers}
        return (
            self.calibration != before.calibration
            or self.override_switch != before.override_switch
            or not set(self.obstacles) <= set(before.obstacles)
            or any(risk not in accepted for risk in new_risks)
        )


def assess(
    values: Mapping[str, float], *, source_system: int, has_receiver: bool | None
) -> Assessment:
    """Judge parameters; ``has_receiver`` as in ``VehicleStatus``."""
    ours: RcCalibration | None = None
    unusable: str | None = None
    try:
        ours = calibration(values)
    except ValueError as error:
        unusable = f"the vehicle's radio calibration is unusable: {error}"
    return Assessment(
        ours,
        unusable,
        override_switch(values),
        tuple(override_obstacles(values, source_system)),
        tuple(dangers(values, has_receiver=has_receiver)),
    )


def calibration(values: Mapping[str, float]) -> RcCalibration:
    """The radio calibration; ValueError if a parameter is missing or contradicts another."""
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
    """Number of the channel that enables overrides, or None."""
    options = {number: values.get(f"RC{number}_OPTION") for number in OPTION_CHANNELS}
    return next((n for n, option in options.items() if option == OVERRIDE_SWITCH_OPTION), None)


def override_obstacles(values: Mapping[str, float], source_system: int) -> Iterator[str]:
    """Reasons, as far as parameters show, for which this vehicle would ignore our overrides."""
    low = values.get("MAV_GCS_SYSID", values.get("SYSID_MYGCS"))
    if low is not None:
        high = max(values.get("MAV_GCS_SYSID_HI", 0), low)
        if not low <= source_system <= high:
            yield (
                f"it obeys system {low:.0f} and we are system {source_system}: use "
                f"--source-system {low:.0f}, or set MAV_GCS_SYSID (SYSID_MYGCS on older firmware)"
            )
    options = int(values.get("RC_OPTIONS", 0))
    if options & _IGNORE_OVERRIDES:
        yield (
            "RC_OPTIONS bit 1 (ignore overrides) is set: use "
            f"--set RC_OPTIONS={options & ~_IGNORE_OVERRIDES}"
        )
    if values.get("RC_OVERRIDE_TIME") == 0:
        yield "RC_OVERRIDE_TIME is 0, which disables overrides: use --set RC_OVERRIDE_TIME=0.5"


def dangers(values: Mapping[str, float], *, has_receiver: bool | None) -> Iterator[Danger]:
    """Settings with which the last sticks would stay for good if this computer died."""
    time_s = values.get("RC_OVERRIDE_TIME")
    if time_s is not None and time_s < 0:
        yield Danger(
            "endless-override",
            "if this computer died, the vehicle would hold its last sticks for ever "
            f"(RC_OVERRIDE_TIME is {time_s:g}): use --set RC_OVERRIDE_TIME=0.5",
        )
    if values.get("FS_THR_ENABLE") == 0 and has_receiver is not True:
        yield Danger(
            "no-throttle-failsafe",
            "no receiver was seen, and without its throttle failsafe (FS_THR_ENABLE is 0) the "
            "vehicle would hold its last sticks for ever if this computer died: use "
            "--set FS_THR_ENABLE=1",
        )


def advice(values: Mapping[str, float]) -> Iterator[str]:
    """Warnings: they forbid no flight, but should be known before it."""
    missing = [name for name in RISK_NAMES if name not in values]
    if missing:
        yield (
            f"the vehicle has not sent {', '.join(missing)}: whether it holds its last sticks for "
            "ever if this computer dies is not known"
        )
    time_s = values.get("RC_OVERRIDE_TIME", 0.0)
    if time_s > _LONGEST_S:
        yield (
            f"RC_OVERRIDE_TIME is {time_s:g}: if this computer died, the vehicle would hold its "
            "last sticks for that many seconds: use --set RC_OVERRIDE_TIME=0.5"
        )
