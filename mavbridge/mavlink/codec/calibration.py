"""Sticks <-> PWM with the vehicle's own radio calibration: the one table of signs and channels."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

from mavbridge.core.vehicle import Sticks

Pwm: TypeAlias = tuple[int, int, int, int]
"""Throttle, yaw, pitch, roll in us."""

PWM_SIGN = Sticks(throttle=1.0, yaw=1.0, pitch=-1.0, roll=1.0)
"""ArduPilot: stick forward (+pitch, nose down) is PWM below trim; the others rise with it."""

FS_THR_MARGIN_US = 10
"""ArduPilot's own arming check wants RC3_MIN this far above FS_THR_VALUE."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RcChannel:
    """One channel as RCn_* and RCMAP_* describe it; PWM in microseconds."""

    number: int
    """1 to 8."""
    min_us: int
    trim_us: int
    max_us: int
    is_reversed: bool = False

    def __post_init__(self) -> None:
        """Refuse a calibration that sticks cannot be mapped with."""
        if not 1 <= self.number <= 8:
            raise ValueError(f"channel {self.number} is not one of 1..8")
        if not 500 <= self.min_us < self.max_us <= 2500:
            raise ValueError(
                f"RC{self.number}_MIN {self.min_us} and RC{self.number}_MAX {self.max_us} "
                "must lie in 500..2500 us, in this order"
            )

    def to_us(self, stick: float, *, centre_us: float) -> int:
        """Piecewise linear: -1 -> one end, 0 -> centre, +1 -> the other end."""
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
    """Lowest throttle that is not a radio failsafe (FS_THR_VALUE and a margin)."""

    def __post_init__(self) -> None:
        """Refuse two sticks on one channel."""
        numbers = [channel.number for channel in self.channels]
        if len(set(numbers)) != 4:
            raise ValueError(f"RCMAP_* puts two sticks on one channel: {numbers}")
        if self.throttle_floor_us >= self.throttle.max_us:
            raise ValueError(
                f"FS_THR_VALUE leaves no throttle below RC{self.throttle.number}_MAX "
                f"{self.throttle.max_us}"
            )

    @property
    def channels(self) -> tuple[RcChannel, RcChannel, RcChannel, RcChannel]:
        """Channels in the order of ``Sticks``."""
        return self.throttle, self.yaw, self.pitch, self.roll

    def _mapping(self) -> Iterator[tuple[RcChannel, float, float]]:
        """Channel, sign and centre in us of each stick, in the order of ``Sticks``.

        Throttle is a range channel: its centre is the middle, not RCn_TRIM.
        """
        middle_us = (self.throttle.min_us + self.throttle.max_us) / 2
        centres_us = (middle_us, *(channel.trim_us for channel in self.channels[1:]))
        return zip(self.channels, PWM_SIGN, centres_us, strict=True)

    def to_pwm_us(self, sticks: Sticks) -> Pwm:
        """PWM of throttle, yaw, pitch, roll, inside the calibrated range."""
        throttle, yaw, pitch, roll = (
            channel.to_us(stick * sign, centre_us=centre_us)
            for stick, (channel, sign, centre_us) in zip(sticks, self._mapping(), strict=True)
        )
        return max(throttle, self.throttle_floor_us), yaw, pitch, roll

    def to_sticks(self, pwm_us: Pwm) -> Sticks:
        """Sticks that correspond to these PWM values."""
        pairs = zip(pwm_us, self._mapping(), strict=True)
        return Sticks(*(c.to_stick(us, centre_us=centre) * sign for us, (c, sign, centre) in pairs))
