"""What is left when the guard lets go: points 8 and 9 of the guard, on the vehicle."""

from dataclasses import replace
from typing import Any

import pytest

from helpers.guard_flights import CONTRACT, MS, GuardFlight, climbing_first
from mavbridge.core.reasons import Code, because
from mavbridge.core.vehicle import NEUTRAL
from mavbridge.guard.values import Phase
from sitl.ardupilot.flight_modes import Mode
from sitl.vehicle.config import IDLE_RECEIVER_US, MID_RECEIVER_US

FAULT = because(Code.CAMERA_FAILED, camera="")


def fault(flight: GuardFlight) -> None:
    flight.stop(FAULT, is_fault=True)
    flight.until(lambda: flight.guard.is_done, within_s=5)


@pytest.mark.parametrize(
    ("receiver_us", "settings", "mode"),
    [
        (MID_RECEIVER_US, {}, Mode.ALT_HOLD),
        (MID_RECEIVER_US, {"on_fault": "release"}, Mode.ALT_HOLD),
        (MID_RECEIVER_US, {"on_fault": "hold"}, Mode.BRAKE),
        (MID_RECEIVER_US, {"on_fault": "land"}, Mode.LAND),
        (MID_RECEIVER_US, {"on_fault": "rtl"}, Mode.RTL),
        (IDLE_RECEIVER_US, {}, Mode.BRAKE),
        (IDLE_RECEIVER_US, {"on_fault": "release"}, Mode.BRAKE),
    ],
)
def test_after_a_fault_neutral_then_the_mode_then_the_receivers_sticks(
    receiver_us: tuple[int, ...], settings: dict[str, Any], mode: Mode
) -> None:
    flight = GuardFlight(receiver_us=receiver_us, **settings).fly()
    before_ns, before_s = flight.clock.now_ns(), flight.t_s
    fault(flight)

    sent = flight.sticks_sent(before_ns + 1)
    assert sent[0][1] == pytest.approx(NEUTRAL, abs=0.01)
    assert sent[0][0] - before_ns < 10 * MS
    assert all(sticks == pytest.approx(NEUTRAL, abs=0.01) for _, sticks in sent)
    assert flight.ap.mode is mode
    record = flight.record(before_s)
    assert record[-1]["us"] == receiver_us[:4]
    in_mode_s = next(e["t_s"] for e in record if e["mode"] == mode.name)
    theirs_s = next(
        e["t_s"] for e in record if e["us"] == receiver_us[:4] and e["t_s"] > before_s + 0.04
    )
    assert theirs_s >= in_mode_s, "the release comes after the mode is confirmed"
    assert theirs_s - before_s < 0.25


def test_with_an_idle_receiver_hold_keeps_the_height() -> None:
    flight = GuardFlight(receiver_us=IDLE_RECEIVER_US).fly()
    height_m = flight.height_m
    fault(flight)
    flight.run(5)

    assert flight.height_m == pytest.approx(height_m, abs=0.5)


def test_a_lost_request_for_the_mode_is_repeated_at_once() -> None:
    flight = GuardFlight(on_fault="hold").fly()
    flight.up.is_silent = True
    flight.stop(FAULT, is_fault=True)
    flight.run(0.03)
    flight.up.is_silent = False
    took_s = flight.until(lambda: flight.ap.mode is Mode.BRAKE, within_s=2)
    assert took_s < 0.15


# --- without a receiver


def test_without_a_receiver_neutral_goes_on_until_disarming_and_no_failsafe_comes() -> None:
    flight = GuardFlight(climbing_first, receiver_us=None, arm=True).take_off()
    before_s = flight.t_s
    flight.stop()
    flight.until(lambda: flight.phase is Phase.HOLDING, within_s=1)
    flight.until(lambda: not flight.ap.armed, within_s=30)
    flight.until(lambda: flight.guard.is_done, within_s=3)

    record = flight.record(before_s)
    assert not any(entry["failsafe"] for entry in record if entry["armed"])
    assert flight.modes[-1] == "LAND", "the default at a normal end without a receiver"
    assert all(abs(us - 1500) <= 4 for e in record[20:] if e["armed"] for us in e["us"])
    assert (
        flight.phases()[-4:] == [*(Phase.LEAVING, Phase.HOLDING, Phase.RELEASING, Phase.RELEASED)]
        or flight.phases()[-1] is Phase.ENDED
    )


# --- normal ends


# --- modes whose throttle is thrust


@pytest.mark.parametrize("mode", [Mode.STABILIZE, Mode.ACRO])
def test_in_a_thrust_mode_the_mode_goes_first_and_the_throttle_stays_until_then(mode: Mode) -> None:
    contract = replace(CONTRACT, modes=(mode.name,))
    flight = GuardFlight(lambda _: (0.1, 0.0, 0.0, 0.0), contract=contract, on_fault="hold")
    flight.launch(mode)
    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=0.1)
    flight.run(1)
    before_ns = flight.clock.now_ns()
    flight.up.is_silent = True  # the mode is not confirmed at once
    flight.stop(FAULT, is_fault=True)
    flight.run(0.2)
    waiting = flight.sticks_sent(before_ns + 10 * MS)
    flight.up.is_silent = False
    flight.until(lambda: flight.guard.is_done, within_s=5)

    assert {round(sticks.throttle, 2) for _, sticks in waiting} == {0.1}
    assert all(abs(v) < 0.01 for _, sticks in waiting for v in sticks[1:])
    assert flight.ap.mode is Mode.BRAKE
    assert flight.modes_asked(before_ns)


# --- a connection that is down


def test_a_release_that_cannot_be_sent_goes_out_first_when_the_connection_is_back() -> None:
    flight = GuardFlight(on_fault="release").fly()
    flight.network.is_down = True
    flight.stop()
    flight.run(1.5)
    flight.network.is_down = False
    back_ns = flight.clock.now_ns()
    flight.until(lambda: flight.guard.is_done, within_s=4)
    flight.run(0.05)

    first = flight.left(back_ns)[0][1]
    assert first.get_type() == "RC_CHANNELS_OVERRIDE"
    assert first.chan1_raw == 0
    assert flight.record()[-1]["us"] == MID_RECEIVER_US[:4]
