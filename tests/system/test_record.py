"""What a pilot shows, in real processes: recorded by ``mavbridge record`` or in a takeover."""

import json
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from faults.props import Transmitter
from faults.stage import ORDERLY, VEHICLE, staged
from helpers.status import printed_by, status_of
from mavbridge.core.processes import free_port, running
from mavbridge.recording.flight_folder import open_flight
from policy.data.flight_folders import leave_out_failed, read_flight

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm", "--engage-channel", "7")
PITCH_CHANNEL, FORWARD_US, SWITCH = 2, 1300, 7
SMALL = ("--policy", "toge:small:resnet8", "--image-size", "32", "--batch-size", "4")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the expert's flight over a course, and the vehicle's own report of it."""
    folder, port = tmp_path_factory.mktemp("pilot"), free_port()
    camera = ("--camera", f"shm:record-{port}")
    sitl = [sys.executable, "-c", VEHICLE, "--connect", f"udpout:127.0.0.1:{port}", *camera]
    sitl += ["--image-size", "64", "--report", str(folder / "fc.json")]
    sitl += ["--course", "5", "--pilot", "expert"]
    link = ("--connect", f"udp:127.0.0.1:{port}", *camera)
    with running(*sitl, log=folder / "sitl.log"):
        flags = ("--out", str(folder / "flights"), "--on-arm", "--episodes", "1")
        status, printed = printed_by("record", *link, *flags)
    assert status == 0, printed
    assert "episode 1 begins (armed)" in printed
    assert "ended by disarmed, not marked" in printed
    return folder


def test_nothing_is_sent_that_moves_the_vehicle(flown: Path) -> None:
    report = json.loads((flown / "fc.json").read_text())
    assert report["overrides"] == 0
    assert report["releases"] == 0
    assert [entry["mode"] for entry in report["modes"]] == ["ALT_HOLD"]
    assert len(report["gates"]["passed"]) >= 1, "the pilot has moved it, and nobody else"


def test_the_flight_holds_the_pilots_sticks_the_state_the_images_and_the_packets(
    flown: Path,
) -> None:
    flight = open_flight(flown / "flights" / "episode-0001")
    meta = flight.meta
    assert (meta.source, meta.finished, meta.success, meta.crash) == ("pilot", True, None, None)
    assert meta.autopilot is not None
    assert meta.autopilot.startswith("ardupilot")
    rows = [row.tick for row in flight.tick_rows()]
    assert all(tick.sent is None for tick in rows)
    sticks = np.array([tick.rc_sticks for tick in rows if tick.rc_sticks is not None])
    assert len(sticks) > 0.8 * len(rows)
    assert np.ptp(sticks[:, 2]) > 0.5, "it leans forward and brakes"
    assert sum(1 for _ in flight.images()) == flight.frames.num_rows > 100
    assert (flight.folder / "link.tlog").stat().st_size > 100_000
    learnt = read_flight(flight.folder)
    assert len(learnt.target) > 0.7 * len(rows)


def test_it_is_trained_from_and_exported(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = flown / "policy.safetensors"
    flights = str(flown / "flights")
    assert status_of("train", flights, "--out", str(out), *SMALL, "--steps", "3") == 0
    assert out.stat().st_size > 0
    assert "image ages of 20 to 90 ms are assumed" in " ".join(capsys.readouterr().err.split())
    assert status_of("export", flights, "--out", str(flown / "dataset")) == 0
    assert (flown / "dataset" / "meta" / "info.json").is_file()


def test_a_pilot_who_takes_over_by_the_switch_labels_the_flight(tmp_path: Path) -> None:
    transmitter, recording = Transmitter("mid"), tmp_path / "recording"
    with staged(tmp_path, "--receiver", "mid", *transmitter.flags, renders=False) as flying:
        flying.start(*FLY, "--policy", "scripted:hover", "--record", str(recording))
        assert flying.wait_for("FLYING: the policy has control")
        flying.observe(2.5)
        transmitter.move(PITCH_CHANNEL, FORWARD_US)
        transmitter.move(SWITCH, 1000)
        flying.observe(2.0)
        transmitter.move(PITCH_CHANNEL, 1500)
        flying.observe(0.5)
        flying.kill_group(signal.SIGINT)
        status, output = flying.end()
    assert status in ORDERLY, output
    exemplary, _ = leave_out_failed([recording], include_failed=False)
    episode = read_flight(*exemplary)
    assert len(episode.target) > 100
    forward = episode.target[:, 2]
    assert (forward > 0.3).mean() > 0.6  # a pilot's stick of 1300 us, pitch reversed
    np.testing.assert_allclose(episode.target[:, [1, 3]], 0.0, atol=0.05)
