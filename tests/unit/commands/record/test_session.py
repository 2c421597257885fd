"""The guard that listens, the pilot's view of the vehicle, and the status line."""

import io
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from helpers.factories import make_guard_tick, make_plan, make_tick
from helpers.fakes import START_NS, ListSink
from helpers.wire import WireEnd
from mavbridge.commands.config import ListenConfig, RecordConfig
from mavbridge.commands.record.run import CONTRACT, listening_guard, pilot_flight
from mavbridge.commands.record.view import STICKS_FRESH_NS, PilotView, RecordScreen, session_status
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Tick
from mavbridge.core.vehicle import ForwardedPacket, Sticks
from mavbridge.flight.plan import plan_flight
from mavbridge.guard.channel import SocketPort, channel_pair
from mavbridge.guard.wire import GuardStatus, Packets
from mavbridge.mavlink.codec.tlog import PacketPipe


def test_the_guard_only_listens_and_asks_for_the_pilots_sticks_at_the_rate(tmp_path: Path) -> None:
    config = RecordConfig(out=tmp_path, vehicle=ListenConfig(connect="udp:x:1"), rate=50.0)
    guard = listening_guard(config, MonotonicClock())
    assert guard.link.readonly
    assert (guard.link.pilot_hz, guard.link.state_hz) == (50.0, 50.0)
    flight = plan_flight(pilot_flight(config), CONTRACT, is_dual=True).guard
    assert flight.engagement.readonly
    assert flight.stick_period_ns == NS_PER_S // 50
    assert flight.meaning.stick_gains is not None, "the vehicle's sticks in a policy's terms"


def test_no_network_is_loaded_to_record() -> None:
    code = "import sys, mavbridge.commands.record.run; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


STICKS = Sticks(0.1, 0.2, 0.3, 0.4)


@dataclass
class Viewed:
    sink: ListSink
    view: PilotView
    end: WireEnd

    def radio(self, at_ns: int) -> Packets:
        mav = self.end.mav
        channels = mav.rc_channels_encode(0, 8, *[1500] * 18, 255)
        manual = mav.manual_control_encode(1, 0, 0, 500, 0, 0)
        other = mav.heartbeat_encode(2, 3, 81, 2, 4)
        return Packets(
            tuple(
                ForwardedPacket(at_ns, at_ns, self.end.pack(one))
                for one in (channels, manual, other)
            )
        )

    def tick(self, at_ns: int) -> Tick:
        self.view.receive(make_guard_tick(at_ns, release_reason=because(Code.NO_IMAGE)))
        event = self.sink.events[-1]
        assert isinstance(event, Tick)
        return event


@pytest.fixture
def viewed() -> Iterator[Viewed]:
    sink = ListSink()
    ours, guards = map(SocketPort, channel_pair())
    with closing(ours), closing(guards):
        yield Viewed(sink, PilotView(make_plan(), sink=sink, samples=ours), WireEnd())


def status(autopilot: str) -> GuardStatus:
    return GuardStatus(autopilot, "ALT_HOLD", True, False, (1500,) * 8, STICKS)


@pytest.mark.parametrize("autopilot", ["ardupilot 4.7.0", "px4 1.18.0"])
def test_the_message_with_the_sticks_is_counted_by_firmware(viewed: Viewed, autopilot: str) -> None:
    viewed.view.receive(viewed.radio(START_NS))
    assert viewed.view.stick_packets == 0, "no firmware is known yet"
    viewed.view.receive(status(autopilot))
    for k in range(1, 4):
        viewed.view.receive(viewed.radio(START_NS + k))
    viewed.view.receive("a line")
    assert (viewed.view.stick_packets, viewed.view.sticks_ns) == (3, START_NS + 3)


def test_ticks_are_the_pilots_and_old_sticks_are_none(viewed: Viewed) -> None:
    viewed.view.receive(status("ardupilot 4.7.0"))
    viewed.view.receive(viewed.radio(START_NS))
    tick = viewed.tick(START_NS + 10 * NS_PER_MS)
    assert tick.rc_sticks == STICKS
    assert (tick.phase, tick.release_reason) == ("released", because(Code.PILOT_FLIES))
    assert tick.activity == "RELEASED: the pilot flies"
    assert viewed.tick(START_NS + STICKS_FRESH_NS + 1).rc_sticks is None


def test_packets_are_logged_while_there_is_a_log(viewed: Viewed) -> None:
    reader, writer = os.pipe()
    viewed.view.receive(viewed.radio(START_NS))
    radio = viewed.radio(START_NS)
    with closing(PacketPipe(writer, wall_offset_ns=0)) as log:
        viewed.view.log_to(log)
        viewed.view.receive(radio)
        viewed.view.log_to(None)
        viewed.view.receive(viewed.radio(START_NS))
    with os.fdopen(reader, "rb") as logged:
        data = logged.read()
    assert len(data) == sum(8 + len(packet.data) for packet in radio.packets)
    assert data.endswith(radio.packets[-1].data)


def test_the_status_line_tells_state_number_marks_sticks_and_disk() -> None:
    screen = RecordScreen(Console(file=io.StringIO()), rate_hz=100.0, vision_hz=30.0)
    assert "waiting for the vehicle" in screen.status_line().plain
    screen.emit(make_tick(0, rc_sticks=Sticks(0.1, -0.2, 0.3, -1.0)))
    episodes = SimpleNamespace(number=3, current=None, counts=Counter({True: 2, None: 1}))
    screen.shown = session_status(episodes, now_ns=0, disk_gb=4.04, problem=None)
    line = screen.status_line().plain
    sticks = "T+0.10 Y-0.20 P+0.30 R-1.00"
    for part in ("next: episode 3", sticks, "disk 4.0 GB", "2 good 0 bad 1 unmarked"):
        assert part in line
    episodes.current = SimpleNamespace(begin_ns=START_NS)
    now_ns, problem = START_NS + 12 * NS_PER_S, "no sticks of a pilot"
    screen.shown = session_status(episodes, now_ns=now_ns, disk_gb=4.04, problem=problem)
    screen.emit(make_tick(1, rc_sticks=None))
    line = screen.status_line().plain
    assert "RECORDING episode 3  12.0 s" in line
    assert "no sticks  " in line
    assert line.endswith("no sticks of a pilot")
