"""The command before anything is opened: its settings, and what it refuses."""

import subprocess
import sys
from pathlib import Path

import pytest

from helpers.status import status_of
from mavbridge.commands.config import ListenConfig, RecordConfig
from mavbridge.commands.record.run import CONTRACT, listening_guard, pilot_flight
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.flight.plan import plan_flight

CONNECT = ("--connect", "udp:127.0.0.1:14999")


def test_the_guard_only_listens_and_asks_for_the_pilots_sticks_at_the_rate(tmp_path: Path) -> None:
    config = RecordConfig(out=tmp_path, vehicle=ListenConfig(connect="udp:x:1"), rate=50.0)
    guard = listening_guard(config, MonotonicClock())
    assert guard.link.readonly
    assert (guard.link.pilot_hz, guard.link.state_hz) == (50.0, 50.0)
    flight = plan_flight(pilot_flight(config), CONTRACT, is_dual=True).guard
    assert flight.engagement.readonly
    assert flight.stick_period_ns == NS_PER_S // 50
    assert flight.meaning.stick_gains is not None, "the vehicle's sticks in a policy's terms"


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        ((), "name the vehicle: --connect"),
        ((*CONNECT, "--camera", "none"), "nothing to learn from without images"),
        ((*CONNECT, "--camera", "no such file"), "no such file"),
        ((*CONNECT, "--on-arm", "--episode-channel", "7"), "leave one out"),
        ((*CONNECT, "--rate", "5"), "--rate"),
        (("--connect", "udp:nowhere"), "udp:nowhere"),
    ],
)
def test_what_cannot_be_recorded_is_refused_before_anything_is_opened(
    flags: tuple[str, ...], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert status_of("record", "--out", tmp_path / "out", *flags) != 0
    assert says in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_no_network_is_loaded_to_record() -> None:
    code = "import sys, mavbridge.commands.record.run; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
