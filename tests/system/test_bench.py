"""``mavbridge bench`` and its peers with their real processes."""

import json
from pathlib import Path

import pytest

from benchmarks.compare import peer_clients
from mavbridge.__main__ import main
from mavbridge.commands.bench import run
from mavbridge.commands.bench.link import time_link
from mavbridge.commands.bench.run import Effort

pytestmark = pytest.mark.system

TINY = Effort(engine_rounds=1, engine_block_s=0.05, flight_s=1.0, attitudes=50)


def test_a_benchmark_measures_engines_flight_and_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run, "QUICK", TINY)
    monkeypatch.chdir(tmp_path)
    flags = (
        "--quick",
        "--policy",
        "scripted:hover",
        "--single-rate",
        "--rate",
        "50",
        "--json",
        "out/bench.json",
    )
    with pytest.raises(SystemExit) as stopped:
        main(["bench", *flags])
    captured = capsys.readouterr()
    assert stopped.value.code == 0, captured.err
    assert "scripted:hover" in captured.out
    result = json.loads((tmp_path / "out" / "bench.json").read_text())
    (flight,) = result["flights"]
    assert (flight["asked_action_hz"], flight["solves"]) == (50.0, "single rate, 10 steps")
    assert 0 < flight["action_hz"] < 51
    assert flight["stick_hz"] > 50
    assert flight["lateness_ms"]["p50"] > 0
    assert 0 < flight["gate_cpu_cores"] < flight["cpu_cores"]
    assert flight["lost_reports"] == 0
    assert flight["vision_hz"] > 0
    assert flight["vehicle_gap_ms"]["p50"] > 0
    assert [one["p50_ms"] > 0 for one in result["engines"]] == [True]
    for link in result["links"]:
        assert link["sent"] == 50
        # An attitude may be overtaken by the next one, and a shared host may stall.
        assert link["answered"] >= 25
        times = link["round_trip_ms"]
        assert 0 < times["p50"] <= times["p99"] <= times["max"]
        assert link["timing"]["state_to_wire_ms"]["p50"] >= 0
        assert link["timing"]["chunk_to_wire_ms"]["p50"] > 0


def test_a_bare_pymavlink_loop_is_a_client_of_the_link_test() -> None:
    link = time_link(peer_clients()[0][0], attitudes=50)
    assert link.answered >= 25
    assert link.timing.chunk_to_wire_ms is None
