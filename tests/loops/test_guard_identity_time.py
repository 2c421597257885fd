"""Identity, time, parameters and words: points 11, 12, 14 and 15 of the guard, on the vehicle."""

import pytest

from helpers.guard_facts import codes
from helpers.guard_flights import MS, GuardFlight, climbing_first, hovering
from helpers.wire import WireEnd
from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.reasons import Code
from mavbridge.guard.values import Phase
from sitl.ardupilot.flight_modes import Mode
from sitl.vehicle.config import IDLE_RECEIVER_US

ELSEWHERE = ("sitl", 2)


# --- identity


def test_another_address_of_the_same_system_id_is_not_followed_in_flight() -> None:
    flight = GuardFlight().fly()
    stranger = WireEnd(system=1)
    for _ in range(20):
        flight.inject(stranger.heartbeat(mode=6, armed=False), ELSEWHERE)
        flight.run(0.05)

    assert flight.phase is Phase.FLYING, "its mode and its disarming are not ours"
    assert any("also heard from sitl:2, which is ignored" in text for text in flight.messages)


def test_a_vehicle_that_moves_in_flight_is_latched_until_the_next_act() -> None:
    flight = GuardFlight(on_fault="release").fly()
    flight.network.address = ELSEWHERE
    flight.until(lambda: flight.phase is not Phase.FLYING, within_s=1)
    flight.run(6)
    assert flight.phase is Phase.RELEASED
    assert not flight.modes_asked()

    flight.run(3)
    assert flight.phase is Phase.RELEASED, "the same packets come again, from elsewhere"
    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=0.2)


@pytest.mark.parametrize("gap_s", [0.0, 0.1, 1.0])
def test_a_vehicle_whose_clock_goes_on_elsewhere_is_brought_into_safety_there(
    gap_s: float,
) -> None:
    flight = GuardFlight(receiver_us=IDLE_RECEIVER_US).fly()
    flight.up.is_silent = flight.down.is_silent = True
    flight.run(gap_s)
    flight.up.is_silent = flight.down.is_silent = False
    flight.network.address = ELSEWHERE
    flight.until(lambda: flight.ap.mode is Mode.BRAKE, within_s=1.5)
    flight.run(6)
    assert flight.ap.mode is Mode.BRAKE
    assert flight.phase is Phase.RELEASED


def test_a_second_way_to_the_vehicle_is_not_followed_where_the_first_one_pauses() -> None:
    flight = GuardFlight(policy=hovering).fly()
    flight.inject(WireEnd(system=1).heartbeat(mode=2, armed=True), ELSEWHERE)
    flight.run(0.5)
    flight.network.address = ELSEWHERE
    flight.until(lambda: flight.phase is not Phase.FLYING, within_s=1)
    flight.run(1)
    assert not any(Code.MOVED in codes(tick.reason) for tick in flight.ticks)


def test_a_reboot_in_flight_is_latched_and_still_leaves_a_release() -> None:
    flight = GuardFlight().fly()
    flight.run(2)
    before_ns = flight.clock.now_ns()
    flight.vehicle.reboot()
    flight.until(lambda: flight.phase in (Phase.RELEASING, Phase.RELEASED), within_s=1.5)
    flight.run(8)

    assert flight.phase is Phase.RELEASED
    assert not flight.modes_asked(before_ns)
    assert flight.overrides(before_ns)[-1][1] == (0, 0, 0, 0)
    assert any("has rebooted" in text for text in flight.messages)
    flight.ap.set_mode(Mode.ALT_HOLD)
    flight.ap.arm(force=True)
    flight.run(2)
    assert flight.phase is Phase.RELEASED, "armed and ready again, and nobody has asked"


@pytest.mark.parametrize("back_s", [0.5, 2.0, 15.0])
def test_a_clock_that_is_set_back_in_flight_ends_it_in_order(back_s: float) -> None:
    """No reboot: over an idle receiver the vehicle would sink to the ground after a release."""
    flight = GuardFlight(receiver_us=IDLE_RECEIVER_US)
    flight.ap.boot_ns -= 20 * NS_PER_S
    flight.fly()
    flight.ap.boot_ns += round(back_s * NS_PER_S)
    flight.until(lambda: flight.phase is Phase.LEAVING, within_s=0.4)
    flight.run(2)
    assert flight.ap.mode is Mode.BRAKE
    assert not any("has rebooted" in text for text in flight.messages)


# --- time


def test_200_ms_of_delay_each_way_are_noticed() -> None:
    """It grows without a gap in what arrives: only the vehicle's own stamps tell."""
    flight = GuardFlight(on_fault="release").fly(3)
    delay_ms = 0
    while flight.phase is Phase.FLYING and delay_ms < 200:
        delay_ms += 1
        flight.up.delay_ns = flight.down.delay_ns = delay_ms * MS
        flight.run(0.015)

    assert delay_ms < 115, "the contract allows 100 ms, and the grace is another 100"
    assert Code.TOO_OLD in flight.codes


# --- parameters


def test_a_parameter_is_set_for_the_flight_and_put_back_before_the_guard_ends() -> None:
    flight = GuardFlight(
        climbing_first,
        receiver_us=None,
        params={"RC_OVERRIDE_TIME": -1.0},
        link={"set": ("RC_OVERRIDE_TIME=0.5",)},
        arm=True,
    ).take_off()
    assert flight.vehicle.params["RC_OVERRIDE_TIME"] == 0.5
    flight.stop()
    flight.until(lambda: flight.guard.is_done, within_s=25)

    assert flight.vehicle.params["RC_OVERRIDE_TIME"] == -1.0
    assert any("RC_OVERRIDE_TIME" in text and "0.5" in text for text in flight.messages)


# --- heartbeats and words


def test_a_flag_that_contradicts_itself_is_refused() -> None:
    with pytest.raises(UserError, match="--engage-channel"):
        FlyConfig(engage_channel=3)
