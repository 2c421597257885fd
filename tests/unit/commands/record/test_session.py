"""The guard that listens, the pilot's view of the vehicle, and the status line."""

import io
import subprocess
import sys
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from helpers.factories import make_guard_tick, make_plan, make_tick
from helpers.fakes import START_NS, ListSink
from mavbridge.commands.config import ListenConfig, RecordConfig
from mavbridge.commands.record import (
    CONTRACT,
    PilotView,
    RecordScreen,
    pilot_flight,
    session_status,
)
from mavbridge.config.flight import CameraConfig
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.reasons import Code, because
from mavbridge.core.vehicle import Sticks
from mavbridge.flight import guard_process
from mavbridge.flight.plan import plan_flight
from mavbridge.guard.values import GuardSettings
from mavbridge.guard.wire import GuardStatus


def test_the_guard_only_listens_and_asks_for_the_pilots_sticks_at_the_rate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[GuardSettings] = []

    def start(settings: GuardSettings, _clock: MonotonicClock) -> SimpleNamespace:
        told.append(settings)
        return SimpleNamespace(close=lambda: None)

    monkeypatch.setattr(guard_process, "GuardProcess", start)
    config = RecordConfig(
        out=tmp_path,
        vehicle=ListenConfig(connect="udp:x:1"),
        camera=CameraConfig(camera=("down=shm:fpv",)),
        rate=50.0,
    )
    plan = plan_flight(pilot_flight(config), CONTRACT, is_dual=True)
    with ExitStack() as stack:
        guard_process.start_guard(plan.config, MonotonicClock(), stack, pilot_hz=config.rate)
    (guard,) = told
    assert guard.link.readonly
    assert (guard.link.pilot_hz, guard.link.state_hz, guard.link.stick_hz) == (50.0, 50.0, 0.0)
    assert guard.link.min_battery_percent == 0.0
    assert (guard.keeps_packets, guard.realtime) == (True, False)
    assert plan.guard.engagement.readonly
    assert plan.guard.stick_period_ns == NS_PER_S // 50
    assert plan.guard.meaning.stick_gains is not None, "the vehicle's sticks in a policy's terms"
    assert plan.config.camera.sources_of(CONTRACT.cameras) == ("shm:fpv",)


def test_no_network_is_loaded_to_record() -> None:
    code = "import sys, mavbridge.commands.record; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


STICKS = Sticks(0.1, 0.2, 0.3, 0.4)


def test_ticks_are_the_pilots() -> None:
    sink = ListSink()
    view = PilotView(make_plan(), sink=sink)
    view.receive(GuardStatus("ardupilot 4.7.0", "ALT_HOLD", True, False, (1500,) * 8, STICKS))
    view.receive(make_guard_tick(START_NS, release_reason=because(Code.NO_IMAGE)))
    (tick,) = sink.events
    assert tick.rc_sticks == STICKS
    assert (tick.phase, tick.release_reason) == ("released", because(Code.PILOT_FLIES))
    assert tick.activity == "RELEASED: the pilot flies"
    assert view.is_airborne
    assert view.reason == because(Code.NO_IMAGE), "the guard's own"


def test_the_status_line_tells_state_number_marks_sticks_and_disk() -> None:
    screen = RecordScreen(
        Console(file=io.StringIO()), action_hz=100.0, vision_hz=30.0, readonly=True
    )
    assert "waiting for the vehicle" in screen.status_line().plain
    screen.emit(make_tick(0, rc_sticks=Sticks(0.1, -0.2, 0.3, -1.0)))
    episodes = SimpleNamespace(number=3, current=None, counts=Counter({True: 2, None: 1}))
    screen.shown = session_status(episodes, now_ns=0, disk_gb=4.04, problem=None)
    line = screen.status_line().plain
    sticks = "T+0.10 Y-0.20 P+0.30 R-1.00"
    for part in ("next: episode 3", sticks, "state 3 ms", "disk 4.0 GB", "2 good 0 bad 1 unmarked"):
        assert part in line
    episodes.current = SimpleNamespace(begin_ns=START_NS)
    now_ns, problem = START_NS + 12 * NS_PER_S, "no sticks of a pilot"
    screen.shown = session_status(episodes, now_ns=now_ns, disk_gb=4.04, problem=problem)
    screen.emit(make_tick(1, rc_sticks=None))
    line = screen.status_line().plain
    assert "RECORDING episode 3  12.0 s" in line
    assert "no sticks  " in line
    assert line.endswith("no sticks of a pilot")
