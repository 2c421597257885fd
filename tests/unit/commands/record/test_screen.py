import io
from collections import Counter
from dataclasses import replace

import pytest
from rich.console import Console

from helpers.factories import make_tick
from mavbridge.commands.record.view import RecordScreen, Shown
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.vehicle import Sticks

SHOWN = Shown(
    number=3,
    duration_ns=None,
    counts=Counter({True: 2, None: 1}),
    disk_s=4000.0,
    stick_packets=0,
    sticks_ns=0,
    problem=None,
)


@pytest.fixture
def screen() -> RecordScreen:
    return RecordScreen(Console(file=io.StringIO()), rate_hz=100.0, vision_hz=30.0)


def test_the_line_tells_state_number_marks_sticks_and_disk(screen: RecordScreen) -> None:
    assert "waiting for the vehicle" in screen.status_line().plain
    screen.emit(make_tick(0, rc_sticks=Sticks(0.1, -0.2, 0.3, -1.0)))
    screen.shown = SHOWN
    line = screen.status_line().plain
    for part in (
        "next: episode 3",
        "ALT_HOLD armed",
        "T+0.10 Y-0.20 P+0.30 R-1.00",
        "disk 67 min",
        "2 good 0 bad 1 unmarked",
    ):
        assert part in line
    screen.shown = replace(SHOWN, duration_ns=12 * NS_PER_S, problem="no sticks of a pilot")
    screen.emit(make_tick(1, rc_sticks=None))
    line = screen.status_line().plain
    assert "RECORDING episode 3  12.0 s" in line
    assert "no sticks  " in line
    assert line.endswith("no sticks of a pilot")
