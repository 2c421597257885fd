"""A vehicle on the bench without a camera: checked, then flown by a policy that is blind."""

import json
import sys
from pathlib import Path

from faults.stage import STARTS, VEHICLE, was_stalled
from helpers.status import printed_by
from mavbridge.core.errors import ExitCode
from mavbridge.core.processes import free_port, running

BLIND = ("--policy", "scripted:hover", "--camera", "none")


def test_a_vehicle_without_a_camera_is_checked_and_flown(tmp_path: Path) -> None:
    port, report = free_port(), tmp_path / "check.json"
    sitl = (sys.executable, "-c", VEHICLE, "--connect", f"udpout:127.0.0.1:{port}")
    link = ("--connect", f"udp:127.0.0.1:{port}")
    with running(*sitl, log=tmp_path / "sitl.log"):
        for _ in range(STARTS):  # the estimator may need a while on a busy machine
            status, told = printed_by(
                "check", *link, *BLIND, "--timing", "0.5", "--json", str(report)
            )
            if status == ExitCode.DONE:
                break
        assert status == ExitCode.DONE, told
        rows = {row["name"]: row for row in json.loads(report.read_text())["rows"]}
        assert rows["state"]["found"].startswith("disarmed")
        assert rows["RC_OVERRIDE_TIME"]["commands"] == ["--set RC_OVERRIDE_TIME=0.5"]

        for _ in range(STARTS):
            fly = ("--mode", "ALT_HOLD", "--arm", "--duration", "1", "--report", str(report))
            status, told = printed_by(*link, *BLIND, *fly)
            if not was_stalled(report):
                break
        assert status == ExitCode.DONE, told
        assert "frozen" not in told
        assert "black" not in told


def test_a_soak_measures_this_computer_at_the_bundled_vehicle(tmp_path: Path) -> None:
    report = tmp_path / "soak.json"
    words = ("--policy", "scripted:hover", "--timing", "0.5", "--soak", "1", "--json", str(report))
    status, told = printed_by("check", "--connect", "none", *words)
    assert status == ExitCode.DONE, told
    assert "NO-GO" not in told
    document = json.loads(report.read_text())
    soak = document["soak"]
    assert soak["timing"]["sticks"]["slots"] > 80
    # No lateness: where every chunk is sent just before its slot, no slot is left to send in.
    assert soak["timing"]["state_to_wire_ms"]["p50"] > 0
    assert soak["timing"]["action"]["rate_hz"] > 0
    assert soak["timing"]["vision"]["rate_hz"] > 0
    assert 0 < soak["cpu_cores"]["guard"] < 1
    assert [row["area"] for row in document["rows"] if row["name"] == "soak"] == ["computer"]
