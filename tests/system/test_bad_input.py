"""What a user can get wrong: one clear error each, never a traceback."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from faults.props import FrameFeed
from helpers.status import told_by
from mavbridge.core.processes import free_port
from sitl.clock import Clock


def test_help_of_fly_names_every_flag_of_the_contract() -> None:
    status, text = told_by("fly", "--help")
    assert status == 0
    flags = """--connect --policy --checkpoint --dual-rate --num-diffusion-steps --camera --device
        --output --readonly --mode --arm --duration --rerun --report --record --config --set-config
        --print-config"""
    missing = [flag for flag in flags.split() if flag not in text]
    assert missing == []


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Half a second of grey frames."""
    import cv2
    import numpy as np

    path = tmp_path / "grey.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30, (64, 64))
    for _ in range(15):
        writer.write(np.full((64, 64, 3), 90, np.uint8))
    writer.release()
    return path


@pytest.fixture
def camera() -> Iterator[str]:
    """One that delivers frames for as long as the test lasts."""
    name = f"test-{os.getpid()}-bad-input"
    with FrameFeed(name, Clock()):
        yield f"shm:{name}"


def test_a_port_in_use(camera: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        connect = f"udp:127.0.0.1:{other.getsockname()[1]}"
        status, text = told_by("--connect", connect, "--policy", "scripted", "--camera", camera)
    assert status == 2
    assert "Address already in use" in text
    assert "stop the program that has it" in text
    assert "ms" not in text.split()  # no table of a flight that never was


def test_tcp_that_is_refused_is_told_before_the_policy_is_loaded() -> None:
    connect = f"tcp:127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    flags = ("--policy", "scripted", "--camera", "none")
    status, text = told_by("--connect", connect, *flags)
    assert status == 3
    assert text.count("nobody listens there") == 1
    assert "scripted" not in text  # what a loaded policy says of itself


def test_a_viewer_and_a_camera_that_are_not_there_are_told_before_the_policy_is_loaded() -> None:
    url = f"rerun+http://127.0.0.1:{free_port(socket.SOCK_STREAM)}/proxy"
    flags = ("--connect", f"udp:127.0.0.1:{free_port()}", "--policy", "scripted")
    status, text = told_by(*flags, "--camera", "none", "--rerun", f"connect={url}")
    assert (status, "scripted" in text) == (3, False)
    assert "no Rerun viewer listens" in text
    status, text = told_by(*flags, "--camera", "/dev/video999")
    assert (status, "scripted:" in text) == (3, False)
    assert "camera /dev/video999 is not there" in text


def test_no_heartbeat(camera: str, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    flags = ("--policy", "scripted", "--camera", camera, "--set-config", "link.timeout=0.2")
    kept = ("--record", str(tmp_path / "flights" / "1"), "--rerun", str(tmp_path / "flight.rrd"))
    connect = f"udp:127.0.0.1:{free_port()}"
    status, text = told_by("--connect", connect, *flags, *kept, "--report", str(report))
    assert status == 3
    assert "heard nothing" in text
    assert list(tmp_path.iterdir()) == []
    folder, viewed = tmp_path / "flight", tmp_path / "flight.rrd"
    folder.mkdir()
    viewed.write_text("an older flight")
    kept = ("--record", str(folder), "--rerun", str(viewed))
    assert told_by("--connect", connect, *flags, *kept)[0] == 3
    assert (list(folder.iterdir()), viewed.read_text()) == ([], "an older flight")


def test_a_camera_that_ends(video: Path) -> None:
    connect = f"udp:127.0.0.1:{free_port()}"
    flags = ("--connect", connect, "--policy", "scripted", "--camera", str(video))
    status, text = told_by(*flags)
    assert status == 3
    assert "ended after 15 frames" in text
