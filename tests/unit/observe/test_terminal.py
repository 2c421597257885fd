import io
from typing import Any

import pytest
from rich.console import Console

from helpers.factories import (
    START_NS,
    TICK_NS,
    make_released_tick,
    make_state,
    make_tick,
    make_vision_tick,
)
from helpers.reports import report_of
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import Tick
from mavbridge.core.vehicle import NEUTRAL
from mavbridge.observe.terminal import MAX_MESSAGES, PLAIN_PERIOD_S, STATUS_HZ, FlightScreen

ONE_UP_AND_ERASE = "\x1b[1A\x1b[2K"
REFRESH_TICKS = round(100 / STATUS_HZ)


def make_screen(console: Console | None = None, *, readonly: bool = False) -> FlightScreen:
    console = console or Console(file=io.StringIO())
    return FlightScreen(console, action_hz=100, vision_hz=30, readonly=readonly)


def shown_screen(*, width: int = 80, **terminal: Any) -> tuple[FlightScreen, io.StringIO]:
    """A screen, and what it prints."""
    out = io.StringIO()
    return make_screen(Console(file=out, width=width, **terminal)), out


def said(text: str) -> Reason:
    return because(Code.POLICY_REFUSED, said=text)


def test_the_line_has_rates_of_a_good_flight_and_none_when_the_loop_has_stopped() -> None:
    screen, lines = make_screen(), []
    for index in range(201):
        screen.emit(make_tick(index))
        if index % 4 == 0:  # 25 Hz
            screen.emit(make_vision_tick(index, ready_ns=START_NS + index * TICK_NS))
        if index % REFRESH_TICKS == 0:
            lines.append(screen.status_line().plain)
    assert lines[-1] == (
        "FLYING  ALT_HOLD armed  action 100.0 Hz  vision 25.0 Hz"
        "  feature 40 ms  state 3 ms  missed 0"
    )
    lines = [screen.status_line().plain for _ in range(2 * round(STATUS_HZ))]
    assert "action - Hz  vision - Hz" in lines[-1]


@pytest.mark.parametrize(
    ("tick", "expected"),
    [
        (make_released_tick(0), "RELEASED  ALT_HOLD armed"),
        (
            make_released_tick(0, because(Code.NO_RECEIVER), sent=NEUTRAL, phase="holding"),
            "HOLDING  ALT_HOLD armed",
        ),
        (
            make_released_tick(0, because(Code.NOT_ENGAGED), phase="waiting"),
            "WAITING  ALT_HOLD armed",
        ),
        (make_tick(0, is_coasting=True), "COASTING  ALT_HOLD armed"),
        (make_tick(0, trace=None), "PREPARING  ALT_HOLD armed"),
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
    screen.emit(make_tick(0, sent=None, readonly=True))
    assert screen.status_line().plain.startswith("READ-ONLY  ")
    screen.emit(make_released_tick(1, because(Code.NO_IMAGE)))
    line = screen.status_line().plain
    assert line.startswith("RELEASED  ")
    assert line.endswith("  no image feature yet")  # last, since it may be long


def test_where_there_is_no_terminal_a_line_is_printed_now_and_then() -> None:
    screen, out = shown_screen()
    with screen.live():
        screen.emit(make_tick(0))
        for _ in range(2 * round(PLAIN_PERIOD_S * STATUS_HZ)):
            screen.refresh()
    message, *lines = out.getvalue().splitlines()
    assert message == "FLYING: the policy has control"
    assert len(lines) == 2
    assert lines[0].startswith("FLYING  ALT_HOLD armed")
    assert lines[0].endswith("missed 0")  # not cut at 80 columns: it goes to a file


def test_messages_are_printed_once_in_order() -> None:
    screen, out = shown_screen()
    no_state = said("no [bold] state")
    screen.emit(make_released_tick(0, reason=no_state, texts=("vehicle: Arming motors",)))
    screen.emit(make_released_tick(1, reason=no_state))
    screen.emit(make_tick(2, trace=None, phase="preparing"))
    screen.emit(make_tick(3, phase="flying"))
    screen.emit(make_tick(3, sent=None, phase="flying"))  # refused by the link
    screen.emit(make_released_tick(4, because(Code.DISARMED), phase="released"))
    screen.emit(make_tick(5, sent=None, phase="flying", readonly=True))
    for _ in range(2):
        screen.refresh()
    assert out.getvalue().splitlines() == [
        "vehicle: Arming motors",
        "RELEASED: no [bold] state",
        "PREPARING: not in control yet",
        "FLYING: the policy has control",
        "RELEASED: the vehicle has been disarmed",
        "READ-ONLY: the policy runs, nothing is sent",
    ]


def test_a_reason_that_keeps_changing_is_shown_once_a_second() -> None:
    screen, out = shown_screen()
    reasons = [because(code) for code in (Code.NO_CHUNK, Code.NO_IMAGE, Code.NOT_ARMED)]
    for index in range(201):
        screen.emit(make_released_tick(index, reasons[index % 3], phase="waiting"))
    screen.refresh()
    lines = out.getvalue().splitlines()
    assert lines == [f"WAITING: {reasons[index % 3]}" for index in (0, 100, 200)]


def test_on_a_terminal_the_line_is_redrawn_and_leaves_nothing_behind() -> None:
    screen, out = shown_screen(width=100, force_terminal=True, color_system=None)
    with screen.live():
        screen.emit(make_tick(0))
        screen.refresh()
        screen.refresh()
    assert out.getvalue().count("FLYING") >= 2
    assert out.getvalue().endswith(ONE_UP_AND_ERASE)


def test_close_prints_what_is_left_and_may_be_called_again() -> None:
    screen, out = shown_screen()
    screen.start(hint="e engages")
    screen.show_message("the last message")
    screen.show_report(report_of(*(make_tick(index) for index in range(11))))
    screen.close(60.0)
    assert out.getvalue().startswith("e engages\nthe last message\n")
    assert "toge-small on torch, ardupilot" in out.getvalue()
    assert "100.0 Hz of 100 Hz" in out.getvalue()
    shown = out.getvalue()
    screen.close(60.0)
    assert out.getvalue() == shown


def test_the_oldest_messages_are_dropped_and_counted() -> None:
    screen, out = shown_screen()
    for number in range(MAX_MESSAGES + 3):
        screen.show_message(f"message {number}")
    screen.refresh()
    assert out.getvalue().splitlines()[:2] == ["(3 older messages were dropped)", "message 3"]


def test_no_line_shows_the_password_of_an_address() -> None:
    screen, text = shown_screen(width=200)
    secret = "camera rtsp://me:it@host/1?token=abc is lost"
    screen.emit(make_released_tick(0, said(secret)))
    line = screen.status_line().plain
    screen.show_message(secret)
    screen.refresh()
    shown = line + text.getvalue()
    assert shown.count("rtsp://me:***@host/1?token=*** is lost") >= 3
    assert "it@" not in shown
    assert "abc" not in shown
