"""The command before anything is opened."""

import subprocess
import sys
from pathlib import Path

from mavbridge.commands.config import ListenConfig, RecordConfig
from mavbridge.commands.record.run import CONTRACT, listening_guard, pilot_flight
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.flight.plan import plan_flight


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
