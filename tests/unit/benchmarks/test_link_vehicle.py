import numpy as np

from benchmarks.link_policy import RollRate
from benchmarks.link_vehicle import (
    CODES,
    PARAMS,
    PENDING_LIMIT,
    RoundTrips,
    code_of,
    code_of_pwm,
    stick_of,
)
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.vehicle import Sticks
from mavbridge.mavlink.outputs.echo import DITHER_STEP_NS, EchoCheck
from mavbridge.mavlink.outputs.sticks import OVERRIDE_ECHO
from mavbridge.mavlink.profiles.ardupilot_sticks import calibration

DITHER_LEVELS = 3


def test_every_code_comes_back_through_policy_calibration_and_dither() -> None:
    echo = EchoCheck(OVERRIDE_ECHO)
    echo.sent((1500, 1500, 1500, 1504), 0)
    echo.received((1500, 1500, 1500, 1504), 1, 1)
    assert echo.confirmed
    feature, history = np.zeros((1, 1), np.float32), np.zeros((1, 4, 4), np.float32)
    state = np.zeros((1, 13), np.float32)
    for code in range(CODES):
        state[0, 7] = stick_of(code)
        chunk = RollRate().predict_fast(feature, state, history, 1)
        assert chunk.shape == (1, 16, 4)
        pwm_us = calibration(PARAMS).to_pwm_us(Sticks(*chunk[0, 0].tolist()))
        dithered_us = {
            echo.with_dither(pwm_us, level * DITHER_STEP_NS)[3] for level in range(DITHER_LEVELS)
        }
        assert len(dithered_us) == DITHER_LEVELS
        assert {*map(code_of_pwm, dithered_us)} == {code}


def test_every_code_comes_back_through_manual_control() -> None:
    assert [code_of(round(1000 * stick_of(code)) / 1000) for code in range(CODES)] == [
        *range(CODES)
    ]


def test_nothing_counts_before_the_start_and_a_lost_answer_ends_the_row() -> None:
    trips = RoundTrips()
    trips.send(0, 0)
    trips.answer(0, 1)
    assert trips.answered_in_a_row == 1
    assert (trips.answers().sent, trips.answers().answered) == (0, 0)
    for code in range(1, PENDING_LIMIT + 2):
        trips.send(code, 2)
    assert trips.answered_in_a_row == 0


def test_the_first_answer_to_its_own_attitude_is_timed() -> None:
    trips = RoundTrips()
    trips.start()
    trips.send(7, 1000 * NS_PER_MS)
    trips.send(8, 1010 * NS_PER_MS)
    for code, arrived_ms in ((9, 1011), (8, 1012), (8, 1030)):
        trips.answer(code, arrived_ms * NS_PER_MS)
    answers = trips.answers()
    assert (answers.sent, answers.answered) == (2, 1)
    assert answers.round_trip_ms.max == 2.0
