import base64
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.factories import make_released_tick, make_tick
from helpers.recordings import make_frame, make_meta, write_recording
from mavbridge.commands.inspect.analysis import FlightAnalysis
from mavbridge.commands.inspect.page import write_page
from mavbridge.core.course import CourseGate
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Position
from policy.contract import Contract

NASTY = "</script><script>document.title = 'mine'</script><!--"
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


def flight(folder: Path, *, name: str = "scripted:hover", frames: int = 10) -> FlightAnalysis:
    ticks = [
        make_tick(index, position_ned_m=Position(0.1 * index, 1.0, -2.0)) for index in range(40)
    ]
    end = make_released_tick(40, because(Code.POLICY_REFUSED, said=NASTY), phase="released")
    events = [*map(make_frame, range(frames)), *ticks, end]
    write_recording(folder, events, meta=make_meta(policy=name))
    analysis = FlightAnalysis(folder)
    analysis.gates = (CourseGate(Position(5, 0, -2), 0.1, 2.4),)
    return analysis


def data_of(text: str) -> list[dict[str, Any]]:
    """What a browser reads from the page."""
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.DOTALL)
    read: list[dict[str, Any]] = json.loads(found[1])
    return read


def unpacked(text: str) -> list[float]:
    values: list[float] = np.frombuffer(base64.b64decode(text), "<f4").tolist()
    return values


def test_the_page_holds_the_flight_and_needs_nothing_else(tmp_path: Path) -> None:
    analysis = flight(tmp_path / "flight")
    write_page(tmp_path / "page.html", [analysis])
    text = (tmp_path / "page.html").read_text()
    assert not re.search(r"https?://|(src|href)=|@import|url\(", text)
    assert "{{" not in text
    (shown,) = data_of(text)
    assert unpacked(shown["t"]) == pytest.approx([0.01 * index for index in range(41)])
    plots = {plot["title"]: plot for plot in shown["plots"]}
    (height,) = plots["Height above the origin"]["series"]
    assert unpacked(height["values"])[:40] == pytest.approx([2.0] * 40)
    assert [line["name"] for line in plots["Stick: yaw"]["series"]][-1] == "sent"
    limits = [(each["name"], each["value"]) for each in plots["Age when sent"]["limits"]]
    assert limits == [("feature limit", 300), ("attitude limit", 100)]
    assert shown["gates"] == [{"center_ned_m": [5, 0, -2], "yaw_rad": 0.1, "size_m": 2.4}]
    assert unpacked(shown["track"]["north"])[10] == pytest.approx(1.0)
    video = base64.b64decode(shown["video"]["source"].partition(",")[2])
    assert video == (tmp_path / "flight/camera.mp4").read_bytes()
    assert list(shown["video"]) == ["source", "exposed_s"]  # sought by stamps, not by a rate


def test_no_name_or_reason_leaves_its_place(tmp_path: Path) -> None:
    write_page(tmp_path / "page.html", [flight(tmp_path / "flight", name=NASTY)])
    text = (tmp_path / "page.html").read_text()
    assert NASTY not in text
    assert text.count("</script>") == 2
    (shown,) = data_of(text)
    assert shown["facts"][0][1].startswith(NASTY)
    assert shown["moments"][0]["detail"].startswith(NASTY)
    assert [span["reason"] for span in shown["holders"]] == ["", NASTY]


def test_a_video_that_browsers_do_not_play_is_not_put_into_the_page(tmp_path: Path) -> None:
    frames = [make_frame(k, rgb=np.full((48, 64), k, np.uint16)) for k in range(5)]
    meta = make_meta(contract=Contract(image_channels="depth"))
    write_recording(tmp_path / "depth", [*frames, make_tick(0)], meta=meta)
    write_page(tmp_path / "page.html", [FlightAnalysis(tmp_path / "depth")])
    (shown,) = data_of((tmp_path / "page.html").read_text())
    assert list(shown["video"]) == ["note"]
    assert "camera.mp4 holds depth" in shown["video"]["note"]


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed here")
def test_a_browser_draws_it_to_the_end(tmp_path: Path) -> None:
    flights = [flight(tmp_path / "one"), flight(tmp_path / "two", name=NASTY, frames=0)]
    flights[1].track = None
    write_page(tmp_path / "page.html", flights)
    command = [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"]
    command += ["--disable-background-networking", "--disable-sync", "--enable-logging=stderr"]
    command += [f"--user-data-dir={tmp_path}/profile", "--dump-dom", f"file://{tmp_path}/page.html"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert 'data-drawn="2"' in ended.stdout  # set by the last line of the script
    assert "CONSOLE" not in ended.stderr
    assert "<title>mavbridge: one and two</title>" in ended.stdout
    plots, bands, path = 10, 1, 2
    assert ended.stdout.count("<canvas") == 2 * (plots + bands) + path
