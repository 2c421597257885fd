"""Who gets the sticks, and how (docs/safety.md): points 1, 3 and 7 of the guard, on the vehicle."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.guard_flights import (
    CONTRACT,
    MS,
    GuardFlight,
    climbing_first,
    leaning,
)
from mavbridge.core.errors import UserError
from mavbridge.core.reasons import Code
from mavbridge.guard.values import Phase
from sitl.ardupilot.flight_modes import Mode
from sitl.vehicle.config import MID_RECEIVER_US

ARM = dialect.MAV_CMD_COMPONENT_ARM_DISARM
SWITCH = 7
TWO_MODES = replace(CONTRACT, modes=("ALT_HOLD", "LOITER"))
LOW, HIGH = 1000, 2000


def test_arm_idles_the_throttle_until_the_policy_takes_over_from_there() -> None:
    flight = GuardFlight(climbing_first, receiver_us=None, arm=True).take_off(2.5)
    sticks = [sticks for _, sticks in flight.sticks_sent()]
    steps = [b.throttle - a.throttle for a, b in pairwise(sticks)]

    assert sticks[0].throttle == pytest.approx(-1.0, abs=0.05)
    assert max(steps) < 0.09, "8 /s at 100 Hz, and not a jump from idle to the policy"


@pytest.mark.parametrize("receiver_us", [None, MID_RECEIVER_US], ids=["no receiver", "receiver"])
@pytest.mark.parametrize("gap_s", [0.15, 0.5, 1.0, 4.0])
@pytest.mark.parametrize("lost", ["refused", "to the vehicle", "from the vehicle"])
def test_a_gap_of_the_link_delays_arming_and_never_prevents_it(
    lost: str, gap_s: float, receiver_us: tuple[int, ...] | None
) -> None:
    """Nothing is sent meanwhile: what the echo shows then must not keep us from trying again."""
    flight = GuardFlight(climbing_first, receiver_us=receiver_us, arm=True, mode="ALT_HOLD")
    flight.until(lambda: flight.phase is Phase.PREPARING, within_s=12)
    if lost == "refused":
        flight.network.send = lambda data, peer=None: False  # type: ignore[method-assign]
    flight.up.is_silent, flight.down.is_silent = lost == "to the vehicle", lost.startswith("from")
    flight.run(gap_s)
    if lost == "refused":
        del flight.network.send  # type: ignore[attr-defined]
    flight.up.is_silent = flight.down.is_silent = False
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=5)


@pytest.mark.parametrize("dropout", [{"ch7": 988}, {"ch7": 988, "ch3": 950}, {"ch7": 65535}])
@pytest.mark.parametrize(("is_flying", "seconds"), [(True, 0.6), (False, 1.5)])
def test_a_receiver_that_drops_out_and_comes_back_engages_nothing(
    dropout: dict[str, int], is_flying: bool, seconds: float
) -> None:
    flight = GuardFlight(engage_channel=SWITCH)
    flight.receiver(ch7=LOW if is_flying else HIGH)
    flight.launch()
    if is_flying:
        flight.receiver(ch7=HIGH)
        flight.until(lambda: flight.phase is Phase.FLYING, within_s=0.3)
    flight.run(0.5)
    flight.receiver(**dropout)
    flight.run(seconds)
    flight.receiver(**dict.fromkeys(dropout, 1500) | {"ch7": HIGH})
    flight.run(0.5)
    flight.ap.set_mode(Mode.ALT_HOLD)  # the pilot leaves what a failsafe has chosen
    flight.run(0.5)
    assert flight.view.flights == is_flying, flight.describe()


def test_the_keys_engage_and_release() -> None:
    flight = GuardFlight().fly()
    flight.act("release")
    flight.until(lambda: flight.phase is Phase.RELEASED, within_s=1.2)
    assert flight.codes == (Code.OPERATOR,)
    assert not flight.modes_asked(), "with a receiver the sticks are given back in the same mode"

    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=0.1)


def test_a_mode_in_the_air_is_asked_for_while_the_pilot_keeps_the_sticks() -> None:
    flight = GuardFlight(contract=TWO_MODES, mode="LOITER").launch()
    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=0.3)

    assert flight.modes_asked() == [Mode.LOITER]
    first_ns = flight.overrides()[0][0]
    assert not flight.modes_asked(first_ns), "the sticks come once the mode has been confirmed"
    assert flight.phases() == [Phase.WAITING, Phase.PREPARING, Phase.FLYING]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"mode": "RTL"}, "--mode RTL: this policy flies in ALT_HOLD or ALTCTL only"),
        ({"mode": "STABILIZE"}, "--mode STABILIZE: this policy flies in ALT_HOLD"),
        ({"mode": "GUIDED"}, "--mode GUIDED"),
    ],
)
def test_a_mode_that_the_contract_does_not_name_is_refused(
    changes: dict[str, Any], told: str
) -> None:
    with pytest.raises(UserError, match=told):
        GuardFlight(**changes)


def test_from_pilot_to_policy_without_a_jump_and_back_without_a_blend() -> None:
    flight = GuardFlight(lambda _: (0.0, 0.0, -0.5, -0.5))
    flight.receiver(ch1=1620, ch2=1450, ch3=1540)
    flight.launch()
    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=0.1)
    flight.run(1)

    channels = [us for _, us in flight.overrides()]
    assert channels[0] == pytest.approx((1620, 1450, 1540, 1500), abs=12)
    jumps_us = [
        max(abs(a - b) for a, b in zip(one, other, strict=True))
        for one, other in pairwise(channels)
    ]
    assert max(jumps_us) <= 52, "8 /s at 100 Hz are 40 us, and the echo's steps are 4 or 8"
    assert channels[-1][:2] == pytest.approx((1250, 1750), abs=10)

    flight.ap.set_mode(Mode.LOITER)
    taken_s = flight.t_s
    flight.run(0.06)
    assert flight.record(taken_s)[-1]["us"] == (1620, 1450, 1540, 1500)
    between = {entry["us"][0] for entry in flight.record(taken_s)}
    assert between <= {*range(1240, 1260), 1620}, "the sticks were given back in one step"


def test_a_policy_takes_over_where_the_pilot_lands_it_on_the_ground() -> None:
    """Engaged while landed, the policy's first stick follows the idle throttle."""
    flight = GuardFlight(leaning, arm=True)
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=12)
    flight.run(2)
    assert flight.ap.landed, "neutral throttle is no take-off"
    assert flight.phase is Phase.FLYING
    assert flight.clock.now_ns() - flight.overrides()[-1][0] < 20 * MS
