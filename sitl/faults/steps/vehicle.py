"""Steps of the vehicle, its pilot and other stations, beyond what ``steps`` has."""

import struct
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl import UsageError
from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.faults.stage.relay import VEHICLE, Message, set_fields
from sitl.faults.stage.stage import Stage
from sitl.faults.stage.transmitter import Transmitter
from sitl.px4.params import Px4Params

STAMPS = {"time_boot_ms": NS_PER_S // NS_PER_MS, "time_usec": 1_000_000, "tc1": NS_PER_S}
"""Fields with the vehicle's time, and their units in a second."""


@dataclass(frozen=True, kw_only=True)
class ClockStep:
    """The vehicle's clock jumps, in every message that carries it."""

    s: float

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""

        def change(message: Message) -> bool:
            for name, units in STAMPS.items():
                stamp = getattr(message, name, 0)
                if stamp:
                    set_fields(message, **{name: max(1, stamp + round(self.s * units))})
            return True

        return stage.relay.rewrite(change)


@dataclass(frozen=True, kw_only=True)
class SetParam:
    """Another station sets a parameter of the vehicle."""

    name: str
    value: float

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""
        value, kind = self.value, dialect.MAV_PARAM_TYPE_REAL32
        if stage.is_px4 and Px4Params().kind(self.name) == dialect.MAV_PARAM_TYPE_INT32:
            (value,) = struct.unpack("<f", struct.pack("<i", int(value)))
            kind = dialect.MAV_PARAM_TYPE_INT32
        name = self.name.encode()
        return stage.relay.inject(dialect.MAVLink_param_set_message(*VEHICLE, name, value, kind))


@dataclass(frozen=True, kw_only=True)
class Switch:
    """The pilot moves a stick or a switch of the transmitter, which the scenario has to have."""

    channel: int
    us: int

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""
        at_ns = stage.clock.now_ns()
        _transmitter(stage).move(self.channel, self.us)
        return at_ns


@dataclass(frozen=True, kw_only=True)
class RadioLost:
    """The receiver hears the transmitter no more, or again."""

    lost: bool = True

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""
        at_ns = stage.clock.now_ns()
        transmitter = _transmitter(stage)
        (transmitter.switch_off if self.lost else transmitter.switch_on)()
        return at_ns


def _transmitter(stage: Stage) -> Transmitter:
    if stage.transmitter is None:
        raise UsageError("this flight has no transmitter: transmitter = true gives it one")
    return stage.transmitter
