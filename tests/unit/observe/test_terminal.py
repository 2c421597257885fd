import io

import pytest
from rich.console import Console, RenderableType

from helpers.factories import (
    START_NS,
    TICK_NS,
    make_released_tick,
    make_state,
    make_tick,
    make_vision_tick,
)
from mavbridge.config.rates import STATUS_HZ
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.records import Tick
from mavbridge.core.vehicle import LinkStats, Percentiles
from mavbridge.observe.terminal import (
    PLAIN_PERIOD_S,
    FlightScreen,
    timing_table,
    verdicts,
)
from mavbridge.observe.timing import FlightTiming, ObserverDrops, TimingReport

ONE_UP_AND_ERASE = "\x1b[1A\x1b[2K"
REFRESH_TICKS = round(100 / STATUS_HZ)


def make_screen(console: Console | None = None, *, readonly: bool = False) -> FlightScreen:
    console = console or Console(file=io.StringIO())
    return FlightScreen(console, action_hz=100, vision_hz=30, readonly=readonly)


def rendered(what: RenderableType, width: int = 100) -> str:
    console = Console(file=io.StringIO(), width=width, record=True)
    console.print(what)
    return console.export_text()


def fly(screen: FlightScreen, *, ticks: int, first: int = 0) -> str:
    """Emit ticks, and frames at 25 Hz, as they come between refreshes; the last line."""
    line = ""
    for index in range(first, first + ticks):
        screen.emit(make_tick(index))
        if index % 4 == 0:
            screen.emit(make_vision_tick(index, ready_ns=START_NS + index * TICK_NS))
        if index % REFRESH_TICKS == 0:
            line = screen.status_line().plain
    return line


def report_of(
    *ticks: Tick, link: LinkStats | None = None, rerun_drops: int | None = None
) -> TimingReport:
    timing = FlightTiming(action_hz=100, vision_hz=30)
    for tick in ticks:
        timing.emit(tick)
    return timing.report(
        mode="dual",
        engine="torch",
        policy="toge-small",
        autopilot="ardupilot",
        link=link,
        observer_drops=ObserverDrops(rerun=rerun_drops, recorder=None),
    )


def verdict_lines(report: TimingReport) -> list[str]:
    return [verdict.plain for verdict in verdicts(report)]


def test_the_line_of_a_good_flight() -> None:
    assert fly(make_screen(), ticks=201) == (
        "FLYING  ALT_HOLD armed  action 100.0 Hz  vision 25.0 Hz"
        "  feature 40 ms  state 3 ms  missed 0"
    )


def test_before_the_first_tick_the_line_says_so() -> None:
    assert make_screen().status_line().plain == "waiting for the first tick"


@pytest.mark.parametrize(
    ("tick", "expected"),
    [
        (make_released_tick(0, "no feature yet"), "RELEASED  ALT_HOLD armed"),
        (make_tick(0, armed=False), "FLYING  ALT_HOLD disarmed"),
        (make_tick(0, mode=None), "FLYING  mode unknown armed"),
        (make_tick(0, feature_captured_ns=None), "feature - ms"),
        (make_tick(0, state=None), "state - ms"),
        (make_tick(0, missed_slots=7), "missed 7"),
        (make_tick(0, state=make_state(START_NS - 118 * NS_PER_MS)), "state 120 ms"),
    ],
)
def test_the_line_shows_what_the_newest_tick_says(tick: Tick, expected: str) -> None:
    screen = make_screen()
    screen.emit(tick)
    assert expected in screen.status_line().plain


def test_readonly_is_not_called_flying_and_a_release_stays_a_release() -> None:
    screen = make_screen(readonly=True)
    screen.emit(make_tick(0, sent=None))
    assert screen.status_line().plain.startswith("READ-ONLY  ")
    screen.emit(make_released_tick(1, "no feature yet"))
    line = screen.status_line().plain
    assert line.startswith("RELEASED  ")
    assert line.endswith("  no feature yet")  # last, since it may be long


def test_one_refresh_is_no_rate_yet() -> None:
    screen = make_screen()
    screen.emit(make_tick(0))
    assert "action - Hz  vision - Hz" in screen.status_line().plain


def test_a_loop_that_has_stopped_has_no_rate() -> None:
    screen = make_screen()
    assert "action 100.0 Hz" in fly(screen, ticks=201)
    lines = [screen.status_line().plain for _ in range(2 * round(STATUS_HZ))]
    assert "action - Hz  vision - Hz" in lines[-1]


def test_the_rate_follows_within_the_window() -> None:
    screen = make_screen()
    fly(screen, ticks=201)
    line = ""
    for number in range(1, 101):  # half the rate from here on
        screen.emit(make_tick(200 + 2 * number))
        if number % (REFRESH_TICKS // 2) == 0:
            line = screen.status_line().plain
    assert "action 50.0 Hz" in line


def test_the_line_is_cut_not_wrapped_on_a_narrow_terminal() -> None:
    out = io.StringIO()
    console = Console(file=out, width=60, force_terminal=True, color_system=None)
    screen = make_screen(console)
    with screen.live():
        screen.emit(make_released_tick(0, "a very long reason " * 10))
        screen.refresh()
        shown = out.getvalue().split("RELEASED")[-1]
    assert shown.rstrip().endswith("\N{HORIZONTAL ELLIPSIS}")
    assert "\n" not in shown


def test_where_there_is_no_terminal_a_line_is_printed_now_and_then() -> None:
    out = io.StringIO()
    screen = make_screen(Console(file=out, width=80))
    with screen.live():
        screen.emit(make_tick(0))
        for _ in range(2 * round(PLAIN_PERIOD_S * STATUS_HZ)):
            screen.refresh()
    message, *lines = out.getvalue().splitlines()
    assert message == "FLYING: the policy has the sticks"
    assert len(lines) == 2
    assert lines[0].startswith("FLYING  ALT_HOLD armed")
    assert lines[0].endswith("missed 0")  # not cut at 80 columns: it goes to a file


def test_messages_are_printed_once_in_order() -> None:
    out = io.StringIO()
    screen = make_screen(Console(file=out, width=80))
    screen.emit(make_released_tick(0, reason="no [bold] state", texts=("vehicle: Arming motors",)))
    screen.emit(make_released_tick(1, reason="no [bold] state"))
    screen.emit(make_tick(2, trace=None))
    screen.emit(make_tick(3))
    screen.emit(make_tick(4, sent=None))
    for _ in range(2):
        screen.refresh()
    assert out.getvalue().splitlines() == [
        "vehicle: Arming motors",
        "RELEASED: no [bold] state",
        "PREPARING: sticks idle",
        "FLYING: the policy has the sticks",
        "READ-ONLY: the policy runs, nothing is sent",
    ]


def test_on_a_terminal_the_line_is_redrawn_and_leaves_nothing_behind() -> None:
    out = io.StringIO()
    console = Console(file=out, width=100, force_terminal=True, color_system=None)
    screen = make_screen(console)
    with screen.live():
        screen.emit(make_tick(0))
        screen.refresh()
        screen.refresh()
    assert out.getvalue().count("FLYING") >= 2
    assert out.getvalue().endswith(ONE_UP_AND_ERASE)


def test_the_table_holds_what_was_measured_in_milliseconds() -> None:
    table = timing_table(report_of(*(make_tick(index) for index in range(11))))
    assert table is not None
    text = rendered(table)
    rows = {
        cells[0]: cells[1:]
        for line in text.splitlines()
        if line.startswith("│")
        for cells in [[cell.strip() for cell in line.strip("│").split("│")]]
    }
    assert rows["action period"] == ["10.00"] * 4
    assert rows["predict"] == ["2.00"] * 4
    assert rows["feature age at send"] == ["40.00"] * 4
    assert rows["attitude age at send"] == ["3.00"] * 4
    assert not rows.keys() & {"vision encode", "link round trip"}
    assert "A slot is one period" in text


def test_the_table_fits_eighty_columns() -> None:
    slow = [make_tick(k, woke_ns=START_NS + k * 100_000 * NS_PER_MS) for k in range(3)]
    table = timing_table(report_of(*slow))
    assert table is not None
    assert max(len(line) for line in rendered(table).splitlines()) <= 80


def test_verdicts_compare_targets_and_results() -> None:
    link = LinkStats(
        messages_per_s=(),
        lost_fraction=0.0,
        rtt_ms=Percentiles(p50=1, p99=1, p999=1, max=1),
        sent_overrides=11,
        echo_confirmed=True,
    )
    report = report_of(*(make_tick(index) for index in range(11)), link=link, rerun_drops=0)
    assert verdict_lines(report) == [
        "action   100.0 Hz of 100 Hz, 0 missed slots in 11 ticks",
        "vision   - Hz of 30 Hz, 0 frames dropped by the camera",
        "link     11 stick messages sent, echo confirmed, 0.00% of the vehicle's messages lost",
        "sticks   never released",
    ]


def test_verdicts_name_the_last_releases_and_what_observers_missed() -> None:
    reasons = ["a", "b", "c", "d"]
    report = report_of(
        *(make_released_tick(index, reason) for index, reason in enumerate(reasons)), rerun_drops=1
    )
    assert verdict_lines(report)[-2:] == [
        "sticks   released 4 times, last for: b (0.0 s); c (0.0 s); d (0.0 s)",
        "rerun    missed 1 event",
    ]


@pytest.mark.parametrize(
    ("confirmed", "lost", "expected"),
    [
        (False, 0.5, "NO ECHO from the vehicle, 50.00% of the vehicle's messages lost"),
        (None, None, "echo not checked, loss not measured"),
    ],
)
def test_the_link_verdict_is_honest(
    confirmed: bool | None, lost: float | None, expected: str
) -> None:
    link = LinkStats(
        messages_per_s=(),
        lost_fraction=lost,
        rtt_ms=None,
        sent_overrides=1,
        echo_confirmed=confirmed,
    )
    assert verdict_lines(report_of(make_tick(), link=link))[2] == (
        f"link     1 stick message sent, {expected}"
    )


@pytest.mark.parametrize(
    ("period_ns", "style"),
    [(TICK_NS, "green"), (TICK_NS * 105 // 100, "yellow"), (TICK_NS * 2, "red")],
)
def test_a_loop_that_misses_its_rate_is_not_green(period_ns: int, style: str) -> None:
    ticks = [make_tick(k, woke_ns=START_NS + k * period_ns) for k in range(101)]
    assert verdicts(report_of(*ticks))[0].spans[1].style == style


def test_show_report_prints_table_and_verdicts() -> None:
    out = io.StringIO()
    screen = make_screen(Console(file=out, width=100))
    screen.show_report(report_of(*(make_tick(index) for index in range(11))))
    assert "toge-small on torch, ardupilot" in out.getvalue()
    assert "100.0 Hz of 100 Hz" in out.getvalue()


def test_a_flight_without_measurements_has_no_table() -> None:
    out = io.StringIO()
    make_screen(Console(file=out, width=100)).show_report(report_of())
    assert "p99" not in out.getvalue()
    assert "never released" in out.getvalue()
