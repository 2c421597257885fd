"""Hostile datagrams in flights of a PX4 vehicle; `make fuzz` feeds more of them."""

import pytest

from fuzz.link_target import HostileFlight
from mavbridge.core.vehicle import ActionKind


@pytest.mark.parametrize("kind", ["sticks", "attitude", "rates", "velocity"])
def test_hostile_datagrams_neither_fly_nor_break_anything(kind: ActionKind) -> None:
    flight = HostileFlight(1, "px4", kind, share=550)
    flight.run(2250)
    assert flight.fed >= 2250
    assert flight.flights >= 1
