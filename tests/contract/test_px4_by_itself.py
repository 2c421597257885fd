"""PX4's own take-off, hold and landing."""

import pytest

from helpers.contract_peers import named
from helpers.px4_companion import ACCEPTED, LAND, LOITER, MID, TAKEOFF, custom


def has_said(text):
    return lambda messages: any(text in m.text for m in named(messages, "STATUSTEXT"))


def test_the_vehicle_takes_off_holds_and_lands_by_itself(px4_grounded):
    px4_grounded.change("MPC_LAND_SPEED", 1.2)
    px4_grounded.track()
    px4_grounded.get_ready(LOITER)
    ground = named(px4_grounded.seen, "LOCAL_POSITION_NED")[-1].z
    assert px4_grounded.set_mode(TAKEOFF) == ACCEPTED
    assert px4_grounded.arm() == ACCEPTED
    px4_grounded.until(
        lambda m: any(x.landed_state == 2 for x in named(m, "EXTENDED_SYS_STATE")),
        20.0,
        lambda _: px4_grounded.sticks(MID),
    )
    messages = px4_grounded.fly(2.0)
    height = ground - named(messages, "LOCAL_POSITION_NED")[-1].z
    assert px4_grounded.mode() == custom(LOITER)
    assert height == pytest.approx(2.5, abs=0.8)
    assert px4_grounded.set_mode(LAND) == ACCEPTED
    px4_grounded.until(has_said("Landing detected"), 20.0, lambda _: px4_grounded.sticks(MID))
    disarmed = has_said("Disarmed by landing")
    took_s, _ = px4_grounded.until(disarmed, 5.0, lambda _: px4_grounded.sticks(MID))
    assert 1.7 <= took_s <= 2.6
    px4_grounded.fly(0.5)
    assert px4_grounded.mode() == custom(LOITER), "the last one that can arm"
