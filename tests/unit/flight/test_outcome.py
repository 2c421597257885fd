"""What a script is told about a flight."""

import signal
from pathlib import Path

import pytest

from helpers.fakes import FakeClock
from mavbridge.core.stopping import StopRequest
from mavbridge.core.vehicle import LinkStats
from mavbridge.flight.outcome import flight_verdict
from mavbridge.gate.outcome import Outcome
from mavbridge.gate.wire import GateSummary

FLOWN = Outcome(flights=1, has_left_ground=True)
STATS = LinkStats(
    messages_per_s=(),
    lost_fraction=None,
    rtt_ms=None,
    sent_overrides=0,
    echo_confirmed=None,
    vehicle_clock_offset_ns=None,
)


def summary(outcome: Outcome) -> GateSummary:
    return GateSummary(
        autopilot="ArduPilot",
        link=STATS,
        failure=None,
        outcome=outcome,
        params={},
        dropped_messages=0,
        dropped_packets=0,
    )


def stopped(number: int | None) -> StopRequest:
    stop = StopRequest(FakeClock())
    stop.signal_number = number
    return stop


@pytest.mark.parametrize(
    ("outcome", "number", "status", "told"),
    [
        (FLOWN, None, 0, None),
        (FLOWN, signal.SIGINT, 0, None),  # Ctrl-C is how a flight without a duration ends
        (FLOWN._replace(has_left_ground=None), None, 0, None),  # the vehicle does not tell
        (FLOWN._replace(faults=1), None, 4, "a fault"),
        (FLOWN._replace(flights=3, faults=1), signal.SIGINT, 4, "a fault"),
        (FLOWN._replace(is_disarmed=True), None, 3, "was disarmed"),
        (FLOWN._replace(has_left_ground=False), None, 3, "not left the ground"),
        (FLOWN._replace(has_left_ground=False), signal.SIGTERM, 143, "not left the ground"),
        (Outcome(), None, 3, "the policy has not flown: waiting for a chunk"),
        (Outcome(), signal.SIGINT, 130, "the policy has not flown"),
        (None, signal.SIGINT, 130, None),  # an impatient user, while the gate holds neutral
        (None, None, 3, None),
    ],
)
def test_the_status_says_what_a_script_needs(
    outcome: Outcome | None, number: int | None, status: int, told: str | None
) -> None:
    words = None if outcome is None else summary(outcome)
    verdict = flight_verdict(words, stopped(number), reason="waiting for a chunk", readonly=False)
    assert verdict.exit_code == status
    assert (told or "") in (verdict.text or "")
    assert (told is None) == (verdict.text is None)


@pytest.mark.parametrize("record", [None, Path("flights/a b")])
def test_a_fault_is_told_with_its_cause_and_the_command_that_shows_it(record: Path | None) -> None:
    words = summary(FLOWN._replace(faults=1, fault="attitude 104 ms old (limit 100 ms)"))
    told = flight_verdict(words, stopped(None), reason="", readonly=False, record=record).text
    end = "" if record is None else "; see it with: mavbridge inspect 'flights/a b'"
    assert (told or "").endswith(f": attitude 104 ms old (limit 100 ms){end}")


def test_a_flight_that_sends_nothing_needs_no_air() -> None:
    watched = summary(Outcome(flights=1, has_left_ground=False))
    assert flight_verdict(watched, stopped(None), reason="", readonly=True).exit_code == 0
    unseen = summary(Outcome())
    assert flight_verdict(unseen, stopped(None), reason="", readonly=True).exit_code == 3
