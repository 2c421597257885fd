"""Hostile datagrams in flights of both firmwares; `make fuzz` feeds more of them."""

import pytest

from fuzz.link_target import COMBINATIONS, HostileFlight
from mavbridge.core.vehicle import ActionKind
from sitl.vehicle.config import AutopilotName


@pytest.mark.parametrize(("autopilot", "kind"), COMBINATIONS)
def test_hostile_datagrams_neither_fly_nor_break_anything(
    autopilot: AutopilotName, kind: ActionKind
) -> None:
    share = 1100 if autopilot == "ardupilot" else 550
    flight = HostileFlight(1, autopilot, kind, share=share)
    flight.run(4 * share)
    assert flight.fed >= 4 * share
    assert flight.flights >= 1
