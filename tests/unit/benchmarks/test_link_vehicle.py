from benchmarks.link_vehicle import (
    CODES,
    PENDING_LIMIT,
    RoundTrips,
    code_of,
    stick_of,
)
from mavbridge.core.clock import NS_PER_MS


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
