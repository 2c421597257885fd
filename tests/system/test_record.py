"""Flights with --record in real processes, and what is in the folder afterwards."""

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from pymavlink import mavutil

from helpers.stand import Flight, Override, flight
from mavbridge.core.records import Sticks
from mavbridge.recording.flight_folder import RecordedFlight, open_flight

pytestmark = pytest.mark.system

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm", "--policy", "scripted:square")
RELEASE = Override(0, 0, 0, 0)
NEUTRAL = Override(1500, 1500, 1500, 1500)


def pwm_us(sticks: Sticks) -> Override:
    """The simulated vehicle's calibration: 1000 to 2000 us, pitch forward is below trim."""
    return Override(
        roll=round(1500 + 500 * sticks.roll),
        pitch=round(1500 - 500 * sticks.pitch),
        throttle=round(1500 + 500 * sticks.throttle),
        yaw=round(1500 + 500 * sticks.yaw),
    )


def logged_overrides(path: Path) -> Iterator[Override]:
    log = mavutil.mavlogfile(str(path))
    while (message := log.recv_match(type="RC_CHANNELS_OVERRIDE")) is not None:
        yield Override(*(getattr(message, f"chan{k}_raw") for k in range(1, 5)))
    log.f.close()


def assert_rows_match_frames(back: RecordedFlight) -> None:
    assert sum(1 for _ in back.images()) == back.frames.num_rows > 0


def test_the_recording_is_what_happened(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    with flight(tmp_path) as flown:
        rrd = str(folder / "flight.rrd")  # may lie in the same folder
        flown.start(*FLY, "--duration", "3", "--record", str(folder), "--rerun", rrd)
        status, output = flown.end()
    assert status == 0, output
    assert str(folder) in output.splitlines()[-1]
    back, report = open_flight(folder), flown.report()
    assert back.meta.finished
    assert (back.meta.policy, back.meta.mode) == ("scripted:square", "dual")
    assert back.meta.autopilot == report["autopilot"]
    assert back.ticks.num_rows == back.meta.ticks
    assert back.frames.num_rows == back.meta.frames == report["vision"]["frames"]
    assert_rows_match_frames(back)
    assert report["observer_drops"]["recorder"] == 0
    sent = [pwm_us(row.tick.sent) for row in back.tick_rows() if row.tick.sent is not None]
    overrides = flown.relay.overrides
    assert overrides[: len(sent)] == sent
    assert set(overrides[len(sent) :]) == {NEUTRAL, RELEASE}
    assert list(logged_overrides(folder / "link.tlog")) == overrides
    frame_ids = set(back.frames["frame_id"].to_pylist())
    used = {row.tick.feature_frame_id for row in back.tick_rows() if row.tick.sent is not None}
    assert used - {None} <= frame_ids


def writer_of(bridge_pid: int) -> int:
    """The bridge's child that spawn has started for the video."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            command = (entry / "cmdline").read_bytes()
        except OSError:
            continue
        if parent == bridge_pid and b"spawn_main" in command:
            return int(entry.name)
    raise AssertionError("no writer process")


def bridge_pid(flown: Flight) -> int:
    assert flown._bridge is not None
    return flown._bridge.pid


def test_a_killed_bridge_leaves_a_readable_flight(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    with flight(tmp_path) as flown:
        flown.start(*FLY, "--record", str(folder))
        assert flown.relay.has_flown.wait(60)
        flown.kill(signal.SIGKILL)
        flown.end()  # the output ends with the writer, which has inherited it
    back = open_flight(folder)
    assert not back.meta.finished
    assert back.ticks.num_rows > 0
    assert_rows_match_frames(back)
    assert (folder / "frames.parquet").exists()
    logged = list(logged_overrides(folder / "link.tlog"))
    assert len(logged) > 0
    assert logged == flown.relay.overrides[: len(logged)]


def test_a_killed_writer_does_not_touch_the_flight(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    with flight(tmp_path) as flown:
        flown.start(*FLY, "--duration", "3", "--record", str(folder))
        assert flown.relay.has_flown.wait(60)
        os.kill(writer_of(bridge_pid(flown)), signal.SIGKILL)
        status, output = flown.end()
    assert status == 0, output
    assert output.count("recording no more images: the writer process has died") == 1
    assert flown.relay.overrides[-10:] == [RELEASE] * 10
    assert flown.report()["observer_drops"]["recorder"] > 0
    back = open_flight(folder)
    assert_rows_match_frames(back)
    document = json.loads((folder / "meta.json").read_text())
    assert document["ticks"] == back.ticks.num_rows
    assert document["finished"] is False
