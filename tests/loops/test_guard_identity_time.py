"""Identity, time, parameters and words: points 11, 12, 14 and 15 of the guard, on the vehicle."""

from itertools import pairwise
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.guard_facts import codes, figures
from helpers.guard_flights import MS, GuardFlight, climbing_first, hovering
from helpers.wire import WireEnd
from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.reasons import Code, because
from mavbridge.guard.values import Phase
from sitl.ardupilot.flight_modes import Mode
from sitl.vehicle.config import IDLE_RECEIVER_US, MID_RECEIVER_US

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


def test_a_clock_that_wraps_in_flight_is_no_reboot_and_hides_no_age() -> None:
    flight = GuardFlight()
    flight.ap.boot_ns = flight.ap.now_ns - 2**32 * MS + 30 * NS_PER_S
    flight.fly()
    flight.run((2**32 * MS - flight.ap.uptime_ns) / NS_PER_S + 2)
    assert flight.ap.uptime_ns > 2**32 * MS
    assert flight.phase is Phase.FLYING, flight.describe()
    assert set(flight.phases(flight.clock.now_ns() - 10 * NS_PER_S)) == {Phase.FLYING}

    flight.vehicle.reboot()
    flight.until(lambda: any("has rebooted" in text for text in flight.messages), within_s=8)
    assert flight.phase is not Phase.FLYING


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


def test_a_reboot_while_the_sticks_are_given_back_ends_there() -> None:
    flight = GuardFlight(on_fault="hold").fly()
    flight.run(2)
    flight.stop(because(Code.CAMERA_FAILED, camera=""), is_fault=True)
    flight.run(0.01)
    assert flight.phase is Phase.LEAVING
    flight.vehicle.reboot()
    flight.until(lambda: flight.guard.is_done, within_s=5)
    assert flight.ap.mode is Mode.STABILIZE


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


def test_200_ms_of_delay_from_the_start_are_no_reason_to_begin() -> None:
    flight = GuardFlight()
    flight.up.delay_ns = flight.down.delay_ns = 200 * MS
    with pytest.raises(AssertionError):
        flight.launch()
    found = figures(flight.reason, Code.TOO_OLD)
    assert (found["quantity"], found["limit_ms"]) == ("attitude", 100)
    flight.act("engage")
    flight.run(1)
    assert not flight.overrides()


def test_50_ms_of_delay_each_way_are_flown() -> None:
    flight = GuardFlight()
    flight.up.delay_ns = flight.down.delay_ns = 50 * MS
    flight.fly(5)
    assert flight.phase is Phase.FLYING


# --- parameters


@pytest.mark.parametrize(
    ("params", "receiver_us", "risk", "told"),
    [
        ({"RC_OVERRIDE_TIME": -1.0}, MID_RECEIVER_US, "endless-override", "--set RC_OVERRIDE_TIME"),
        ({"FS_THR_ENABLE": 0.0}, None, "no-throttle-failsafe", "--set FS_THR_ENABLE=1"),
    ],
)
def test_what_would_hold_the_last_stick_for_ever_is_refused_unless_accepted(
    params: dict[str, float], receiver_us: tuple[int, ...] | None, risk: Any, told: str
) -> None:
    flight = GuardFlight(climbing_first, receiver_us=receiver_us, params=params, arm=True)
    flight.run(8)
    assert flight.phase is Phase.WAITING
    assert figures(flight.reason, Code.RISK)["risk"] == risk
    assert told in str(flight.reason)
    assert f"--set-config link.accept_risk={risk}" in str(flight.reason)
    assert not flight.ap.armed
    assert not flight.overrides()

    accepted = {"accept_risk": (risk,)}
    GuardFlight(
        climbing_first, receiver_us=receiver_us, params=params, arm=True, link=accepted
    ).take_off()


def test_a_calibration_that_the_codec_would_refuse_later_is_refused_before_arming() -> None:
    flight = GuardFlight(climbing_first, params={"RC1_MAX": 2250.0}, arm=True)
    flight.run(8)
    assert flight.phase is Phase.WAITING
    assert "RC1_MAX" in str(figures(flight.reason, Code.CALIBRATION_UNUSABLE)["cause"])
    assert not flight.overrides()


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


def test_a_parameter_that_matters_and_changes_in_flight_is_latched() -> None:
    flight = GuardFlight().fly()
    flight.station(
        lambda mav: mav.param_set_encode(
            1, 1, b"RC_OVERRIDE_TIME", -1.0, dialect.MAV_PARAM_TYPE_REAL32
        ),
        system=42,
    )
    flight.vehicle.server.links[0].send_param(
        flight.vehicle.params.names.index("RC_OVERRIDE_TIME")
    )  # ArduPilot tells every link
    flight.until(lambda: flight.phase is Phase.RELEASED, within_s=0.5)

    assert Code.PARAMETER_CHANGED in flight.codes
    assert not flight.modes_asked()


# --- heartbeats and words


def test_heartbeats_are_asked_for_ten_times_a_second_and_come() -> None:
    flight = GuardFlight().launch()
    asked = flight.commands(dialect.MAV_CMD_SET_MESSAGE_INTERVAL)
    assert (dialect.MAVLINK_MSG_ID_HEARTBEAT, 100_000) in asked

    start_ns = flight.clock.now_ns()
    flight.run(2)
    end = WireEnd()
    beats = [
        message
        for at_ns, data in flight.down.sent
        for message in end.read(data)
        if at_ns >= start_ns and message.get_type() == "HEARTBEAT"
    ]
    assert len(beats) == pytest.approx(20, abs=2)


def test_our_own_heartbeats_go_on_through_the_flight() -> None:
    flight = GuardFlight(hovering).fly(5)
    beats_ns = [at_ns for at_ns, m in flight.left() if m.get_type() == "HEARTBEAT"]
    gaps_s = [(b - a) / 1e9 for a, b in pairwise(beats_ns)]
    assert max(gaps_s) < 1.05


def test_engagement_and_release_are_told_to_every_ground_station() -> None:
    flight = GuardFlight().fly()
    flight.pilot_mode(Mode.LOITER)
    flight.run(0.5)

    texts = [m.text for _, m in flight.left() if m.get_type() == "STATUSTEXT"]
    assert texts[0] == "mavbridge: the policy has control"
    said = "".join(texts[1:])
    assert said == "mavbridge: control given back: mode changed from ALT_HOLD to LOITER"


def test_a_flag_that_contradicts_itself_is_refused() -> None:
    with pytest.raises(UserError, match="--engage-channel"):
        FlyConfig(engage_channel=3)
