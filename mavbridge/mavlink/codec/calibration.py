"""Sticks to PWM and back by the vehicle's radio calibration; the only table of their signs."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from mavbridge.core.switch import RADIO_US
from mavbridge.core.vehicle import Sticks

Pwm: TypeAlias = tuple[int, ...]
"""Throttle, yaw, pitch, roll [us]."""

PWM_SIGN = Sticks(throttle=1.0, yaw=1.0, pitch=-1.0, roll=1.0)
"""ArduPilot: stick forward (+pitch, nose down) is PWM below trim; the others increase PWM."""

FS_THR_MARGIN_US = 10
"""Margin of RC3_MIN above FS_THR_VALUE that ArduPilot's arming check demands."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RcChannel:
    """One channel, as described by RCn_* and RCMAP_*; PWM in microseconds."""

    number: int
    """1 to 8."""
    min_us: int
    trim_us: int
    max_us: int
    is_reversed: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError if the calibration cannot map sticks."""
        low_us, high_us = RADIO_US[0], RADIO_US[-1]
        for part, value_us in (("MIN", self.min_us), ("MAX", self.max_us)):
            if value_us not in RADIO_US:
                name, nearest_us = f"RC{self.number}_{part}", min(max(value_us, low_us), high_us)
                raise ValueError(
                    f"{name} {value_us} is not in {low_us}..{high_us} us: calibrate the radio, or "
                    f"use --set {name}={nearest_us}"
                )
        if self.min_us >= self.max_us:
            raise ValueError(
                f"RC{self.number}_MIN {self.min_us} is not below RC{self.number}_MAX "
                f"{self.max_us}: calibrate the radio"
            )

    def to_us(self, stick: float, *, centre_us: float) -> int:
        """Map a stick piecewise linearly: -1 to one end, 0 to the centre, +1 to the other end."""
        signed = -stick if self.is_reversed else stick
        span_us = self.max_us - centre_us if signed >= 0 else centre_us - self.min_us
        return min(max(round(centre_us + signed * span_us), self.min_us), self.max_us)

    def to_stick(self, pwm_us: int, *, centre_us: float) -> float:
        """Inverse of ``to_us``, clipped to [-1, 1]."""
        span_us = self.max_us - centre_us if pwm_us >= centre_us else centre_us - self.min_us
        signed = (pwm_us - centre_us) / span_us if span_us else 0.0
        signed = min(max(signed, -1.0), 1.0)
        return -signed if self.is_reversed else signed


@dataclass(frozen=True, slots=True, kw_only=True)
class RcCalibration:
    """The four stick channels of one vehicle."""

    throttle: RcChannel
    yaw: RcChannel
    pitch: RcChannel
    roll: RcChannel
    throttle_floor_us: int = 0
    """Lowest throttle that is not a radio failsafe: FS_THR_VALUE plus a margin."""
    _mapping: tuple[tuple[RcChannel, float, float], ...] = field(
        init=False, repr=False, compare=False
    )
    """Channel, sign and centre [us] of each stick, in the order of ``Sticks``."""

    def __post_init__(self) -> None:
        """Raise ValueError for a shared channel, or a trim or failsafe out of range."""
        numbers = [channel.number for channel in self.channels]
        if len(set(numbers)) != 4:
            raise ValueError(
                f"RCMAP_* puts two sticks on one channel: {numbers}; give each its own by "
                "RCMAP_ROLL=1 and so on, and reboot the vehicle"
            )
        for channel in self.channels[1:]:
            if not channel.min_us <= channel.trim_us <= channel.max_us:
                name, middle_us = f"RC{channel.number}_TRIM", (channel.min_us + channel.max_us) // 2
                raise ValueError(
                    f"{name} {channel.trim_us} is not in {channel.min_us}..{channel.max_us} us, "
                    f"its MIN and MAX: calibrate the radio, or use --set {name}={middle_us}"
                )
        # Throttle is a range channel: its centre is the middle of MIN and MAX, not RCn_TRIM.
        throttle_us = (self.throttle.min_us + self.throttle.max_us) / 2
        if self.throttle_floor_us >= throttle_us:
            raise ValueError(
                f"FS_THR_VALUE {self.throttle_floor_us - FS_THR_MARGIN_US} makes a failsafe of the "
                f"throttle's middle, {throttle_us:g} us: use --set FS_THR_VALUE=975"
            )
        centres_us = (throttle_us, *(channel.trim_us for channel in self.channels[1:]))
        mapping = tuple(zip(self.channels, PWM_SIGN, centres_us, strict=True))
        object.__setattr__(self, "_mapping", mapping)  # computed once: every stick command needs it

    @property
    def channels(self) -> tuple[RcChannel, RcChannel, RcChannel, RcChannel]:
        """Channels in the order of ``Sticks``."""
        return self.throttle, self.yaw, self.pitch, self.roll

    def stick_channels_us(self, channels_us: Sequence[int]) -> Pwm:
        """Return the PWM of the four sticks among at least eight channels."""
        return tuple(channels_us[channel.number - 1] for channel in self.channels)

    def to_pwm_us(self, sticks: Sticks) -> Pwm:
        """Return the PWM of throttle, yaw, pitch, roll, within the calibrated range."""
        throttle, *others = (
            channel.to_us(stick * sign, centre_us=centre_us)
            for stick, (channel, sign, centre_us) in zip(sticks, self._mapping, strict=True)
        )
        return (max(throttle, self.throttle_floor_us), *others)

    def to_sticks(self, pwm_us: Pwm) -> Sticks:
        """Return the sticks for these PWM values."""
        pairs = zip(pwm_us, self._mapping, strict=True)
        return Sticks(*(c.to_stick(us, centre_us=centre) * sign for us, (c, sign, centre) in pairs))
