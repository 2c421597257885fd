import io
from typing import Any

import pytest
from rich.console import Console

from helpers.factories import START_NS, TICK_NS, make_released_tick, make_tick
from helpers.reports import report_of
from mavbridge.core.reasons import Code, because
from mavbridge.core.vehicle import LinkStats
from mavbridge.observe.terminal import Finding, findings, timing_table
from mavbridge.observe.timing import TimingReport


def verdict_lines(report: TimingReport) -> list[str]:
    return [finding.line.plain for finding in findings(report)]


def test_the_table_holds_what_was_measured_in_milliseconds() -> None:
    table = timing_table(report_of(*(make_tick(index) for index in range(11))))
    console = Console(file=io.StringIO(), width=100, record=True)
    console.print(table)
    text = console.export_text()
    cells = [line.strip("│").split("│") for line in text.splitlines() if line.startswith("│")]
    rows = {name.strip(): [value.strip() for value in values] for name, *values in cells}
    for name, value_ms in (
        ("chunk period", "10.00"),
        ("stick lateness", "2.00"),
        ("predict", "2.00"),
        ("feature age at send", "40.00"),
        ("attitude age at send", "3.00"),
    ):
        assert rows[name] == [value_ms] * 4
    assert not rows.keys() & {"vision encode", "link round trip"}
    assert "a slot is missed when nothing was" in " ".join(text.split())


@pytest.mark.parametrize(
    ("link", "expected"),
    [
        ({"echo_confirmed": False, "lost_fraction": 0.5}, "NO ECHO from the vehicle, 50.00% of"),
        ({"echo_confirmed": None, "lost_fraction": None}, "echo not checked, loss not measured"),
        ({"lost_fraction": 2 / 60_000}, "echo confirmed, under 0.01% of the"),
    ],
)
def test_the_link_verdict_is_honest(link: dict[str, Any], expected: str) -> None:
    good = {"lost_fraction": 0.0, "echo_confirmed": True}
    stats = LinkStats(messages_per_s={}, rtt_ms=None, sent_actions=1, **(good | link))
    (line,) = (each for each in verdict_lines(report_of(make_tick(), link=stats)) if "link" in each)
    assert line.startswith("link     1 command sent, ")
    assert expected in line


def test_verdicts_name_the_last_releases_and_what_observers_missed() -> None:
    reasons = [because(code) for code in (Code.NO_CHUNK, Code.DISARMED, Code.DURATION, Code.SIGNAL)]
    report = report_of(
        *(make_released_tick(index, reason) for index, reason in enumerate(reasons)), rerun_drops=1
    )
    assert verdict_lines(report)[-2:] == [
        "releases released 4 times, last for: the vehicle has been disarmed (0.0 s); "
        "the flight is over (0.0 s); the flight was ended by a signal (0.0 s)",
        "rerun    missed 1 event",
    ]


def test_a_long_name_stays_apart_from_its_text() -> None:
    assert Finding("recording", "cut off").line.plain == "recording cut off"


@pytest.mark.parametrize(
    ("period_ns", "style"),
    [(TICK_NS, "green"), (TICK_NS * 105 // 100, "yellow"), (TICK_NS * 2, "red")],
)
def test_a_policy_that_misses_its_rate_is_not_green(period_ns: int, style: str) -> None:
    ticks = [make_tick(k, woke_ns=START_NS + k * period_ns) for k in range(101)]
    assert findings(report_of(*ticks))[1].style == style
