"""Parts of ``make bench`` with their real processes."""

from benchmarks.link import BARE_CLIENT, OUR_CLIENT, time_link


def test_our_client_answers_the_vehicle_of_the_link_test() -> None:
    link = time_link(OUR_CLIENT, attitudes=50)
    assert link.sent == 50
    # An attitude may be overtaken by the next one, and a shared host may stall.
    assert link.answered >= 25
    assert 0 < link.round_trip_ms.p50 <= link.round_trip_ms.p99 <= link.round_trip_ms.max


def test_a_bare_pymavlink_loop_is_a_client_of_the_link_test() -> None:
    assert time_link(BARE_CLIENT, attitudes=50).answered >= 25
