"""The whole product in real processes over UDP. What is asserted is what happened, not how fast."""

import signal
from pathlib import Path

from faults.processes import Process
from faults.relay import Override, logged_overrides
from faults.stage import ORDERLY, staged
from mavbridge.core.vehicle import Sticks
from mavbridge.recording.flight_folder import RecordedFlight, open_flight

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm")
NEUTRAL = Override(1500, 1500, 1500, 1500)
RELEASE = Override(0, 0, 0, 0)


def pwm_us(sticks: Sticks) -> Override:
    """The simulated vehicle's calibration: 1000 to 2000 us, pitch forward is below trim."""
    return Override(
        roll=round(1500 + 500 * sticks.roll),
        pitch=round(1500 - 500 * sticks.pitch),
        throttle=round(1500 + 500 * sticks.throttle),
        yaw=round(1500 + 500 * sticks.yaw),
    )


def assert_rows_match_frames(back: RecordedFlight) -> None:
    assert sum(1 for _ in back.images()) == back.frames.num_rows > 0


def test_a_flight_holds_its_altitude_gives_the_sticks_back_and_is_reported_and_recorded(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "recording"
    with staged(tmp_path, renders=False) as flying:
        flags = ("--record", str(folder), "--rerun", str(folder / "flight.rrd"))
        status, output = flying.fly(*FLY, "--policy", "scripted:hover", "--duration", "6", *flags)
    assert status == 0, output
    assert "Arming motors" in output
    assert output.count("no real-time scheduling") <= 2, "of the guard and of the policy"
    overrides, report, vehicle = flying.relay.overrides, flying.report(), flying.vehicle_report()
    assert 2.0 < vehicle["max_altitude_m"] < 4.5
    assert not vehicle["crashed"]
    assert [entry["mode"] for entry in vehicle["modes"]][:2] == ["STABILIZE", "ALT_HOLD"]
    # It ends with neutral sticks, but for the steps by which the link hears itself, and releases.
    first = overrides.index(RELEASE)
    assert overrides[first - 1]._replace(roll=1500) == NEUTRAL
    assert 1500 <= overrides[first - 1].roll <= 1502
    assert set(overrides[first:]) == {RELEASE}
    assert vehicle["releases"] >= 1
    assert (report["mode"], report["link"]["echo_confirmed"]) == ("dual", True)
    assert report["link"]["sent_actions"] >= vehicle["overrides"] > 0
    assert report["observer_drops"]["recorder"] == 0

    assert str(folder) in "\n".join(output.splitlines()[-2:])
    back = open_flight(folder)
    assert back.meta.finished
    assert (back.meta.policy, back.meta.mode) == ("scripted:hover", "dual")
    assert back.meta.autopilot == report["autopilot"]
    assert back.ticks.num_rows == back.meta.ticks
    assert back.frames.num_rows == back.meta.frames == report["vision"]["frames"] > 0
    assert_rows_match_frames(back)
    rows = [row.tick for row in back.tick_rows() if row.tick.sent is not None]
    sent = [pwm_us(tick.sent) for tick in rows if tick.sent is not None]
    sticks = [override for override in overrides if override != RELEASE]
    assert sent == sticks[-len(sent) :]  # but for a few before the recording began
    assert len(sticks) - len(sent) < 10
    assert list(logged_overrides(folder / "link.tlog")) == overrides
    frame_ids = set(back.frames["frame_id"].to_pylist())
    assert {tick.feature_frame_id for tick in rows} - {None} <= frame_ids


def test_readonly_runs_both_loops_and_sends_nothing(tmp_path: Path) -> None:
    with staged(tmp_path, renders=False) as flying:
        status, output = flying.fly("--dual-rate", "--readonly", "--duration", "1")
    assert status == 0, output
    shipped = flying.report()
    assert shipped["mode"] == "dual"
    assert shipped["engine"].startswith("openvino")
    assert shipped["action"]["predict_ms"]["p50"] > 0
    assert shipped["vision"]["encode_ms"]["p50"] > 0
    assert flying.relay.overrides == []


def test_a_signal_while_the_recording_is_closed_loses_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    with staged(tmp_path, renders=False) as flying:
        flying.start(*FLY, "--policy", "scripted:square", "--record", str(folder))
        assert flying.relay.has_flown.wait(60)
        guard, writer = flying.guard, Process(flying.pid_of("recorder"), flying.clock)
        flying.observe(0.5)
        writer.kill(signal.SIGSTOP)
        flying.kill(signal.SIGTERM)
        assert guard.has_ended(60)
        flying.observe(0.5)
        flying.kill(signal.SIGHUP)
        writer.kill(signal.SIGCONT)
        assert flying.end()[0] in ORDERLY
    assert flying.report()["outcome"] is not None
    assert open_flight(folder).meta.finished


def test_a_killed_writer_costs_the_images_and_not_the_outcome(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    with staged(tmp_path, renders=False) as flying:
        flying.start(*FLY, "--policy", "scripted:square", "--record", str(folder))
        assert flying.relay.has_flown.wait(60)
        Process(flying.pid_of("recorder"), flying.clock).kill(signal.SIGKILL)
        flying.observe(0.5)
        assert flying.relay.newest_steering(1)[0].is_command  # it flies on
        flying.kill(signal.SIGTERM)
        assert flying.end()[0] in ORDERLY
    meta = open_flight(folder).meta
    assert (meta.finished, meta.outcome is None, bool(meta.parameters)) == (False, False, True)
    assert "images and packets lost" in str(meta.loss)


def test_a_killed_bridge_leaves_a_readable_flight(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    with staged(tmp_path, renders=False) as flying:
        flying.start(*FLY, "--policy", "scripted:square", "--record", str(folder))
        assert flying.relay.has_flown.wait(60)
        flying.kill(signal.SIGKILL)
        flying.end()  # the output ends with the writer, which has inherited it
    back = open_flight(folder)
    assert not back.meta.finished
    assert back.ticks.num_rows > 0
    assert_rows_match_frames(back)
    assert (folder / "frames.arrows").exists(), "as those of all other rows"
    logged = list(logged_overrides(folder / "link.tlog"))
    assert len(logged) > 0
    assert logged == flying.relay.overrides
    assert logged[-1] == RELEASE  # the guard has outlived its parent
