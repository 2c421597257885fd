"""Screen capture on an X server of the test's own; choosing a window needs none."""

import importlib.util
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from helpers.fakes import START_NS, FakeClock
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import CameraError, UserError

if importlib.util.find_spec("mss") is None or importlib.util.find_spec("Xlib") is None:
    pytest.skip("needs the packages mss and python-xlib", allow_module_level=True)

from mavbridge.camera.screen import INTERVAL_NS, ScreenCamera, Window, choose_window

needs_x = pytest.mark.skipif(
    shutil.which("Xvfb") is None or importlib.util.find_spec("tkinter") is None,
    reason="needs Xvfb and tkinter",
)
WINDOWS = [Window(1, "Gazebo"), Window(2, "Terminal 1"), Window(3, "Terminal 2")]


@pytest.mark.parametrize(
    ("windows", "title", "chosen"),
    [
        pytest.param(WINDOWS, "Gazebo", 1, id="exact"),
        pytest.param(WINDOWS, "gaze", 1, id="part, other case"),
        pytest.param([*WINDOWS, Window(4, "Gazebo log")], "Gazebo", 1, id="exact beats part"),
        pytest.param([Window(7, "Sim"), Window(8, "Sim")], "Sim", 8, id="frame and its window"),
    ],
)
def test_a_window_is_chosen_by_title(windows, title, chosen):
    assert choose_window(windows, title).id == chosen


@pytest.mark.parametrize(
    ("windows", "title", "complaint"),
    [
        (WINDOWS, "Unity", "no window has 'Unity'.*'Gazebo', 'Terminal 1', 'Terminal 2'"),
        (WINDOWS, "terminal", "several windows have .*there are: 'Terminal 1', 'Terminal 2'"),
        ([], "Unity", "none with a title"),
    ],
)
def test_a_title_that_names_no_window_lists_what_there_is(windows, title, complaint):
    with pytest.raises(UserError, match=complaint):
        choose_window(windows, title)


@pytest.fixture(scope="module")
def display():
    """An X server, 320x240; it picks a free number and writes it to the pipe."""
    reader, writer = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writer), "-screen", "0", "320x240x24", "-nolisten", "tcp"],
        pass_fds=[writer],
        stderr=subprocess.DEVNULL,
    )
    os.close(writer)
    with os.fdopen(reader) as pipe:
        number = pipe.readline().strip()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DISPLAY", f":{number}")
        yield
    server.terminate()
    server.wait(10)


RED_WINDOW = """
import sys, tkinter
window = tkinter.Tk()
window.title("Red \\N{GREEK SMALL LETTER MU} window")
window.geometry("100x80+50+40")
window.configure(background="#ff2010")
window.update()
print("shown", flush=True)
for command in sys.stdin:
    exec(command)
    window.update()
    print("done", flush=True)
"""


GONE = "window.destroy(); window = type('Gone', (), {'update': lambda self: None})()"


class XWindow:
    """A red window, 100x80 at (50, 40), in a process of its own."""

    def __init__(self, process):
        self._process = process
        assert process.stdout.readline() == "shown\n"

    def do(self, command):
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()
        assert self._process.stdout.readline() == "done\n"


@pytest.fixture
def window(display):
    with subprocess.Popen(
        [sys.executable, "-c", RED_WINDOW], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield XWindow(process)
        process.stdin.close()


@pytest.fixture
def clock():
    return FakeClock()


@needs_x
@pytest.mark.system
@pytest.mark.usefixtures("window")
def test_a_window_is_captured_in_rgb_at_a_pace(clock):
    camera = ScreenCamera("Red μ window", clock=clock)
    frame = camera.read(0)
    assert (frame.frame_id, frame.captured_ns) == (1, START_NS)
    assert frame.rgb.shape == (80, 100, 3)
    assert frame.rgb.dtype == np.uint8
    assert np.unique(frame.rgb.reshape(-1, 3), axis=0).tolist() == [[0xFF, 0x20, 0x10]]
    assert not frame.rgb.flags.writeable
    assert camera.read(NS_PER_MS) is None
    assert clock.now_ns() == START_NS + NS_PER_MS
    assert camera.read(NS_PER_S).captured_ns == START_NS + INTERVAL_NS
    camera.close()
    camera.close()


@needs_x
@pytest.mark.system
@pytest.mark.parametrize("command", ["window.withdraw()", "window.geometry('+1000+0')", GONE])
def test_a_window_that_goes_away_is_dead(window, clock, command):
    camera = ScreenCamera("red", clock=clock)
    window.do(command)
    with pytest.raises(CameraError, match="closed, hidden or moved off"):
        camera.read(NS_PER_S)
    camera.close()


@needs_x
@pytest.mark.system
@pytest.mark.usefixtures("window")
def test_an_empty_title_is_the_whole_screen(clock):
    camera = ScreenCamera("", clock=clock)
    frame = camera.read(0)
    assert frame.rgb.shape == (240, 320, 3)
    assert frame.rgb[80, 100].tolist() == [0xFF, 0x20, 0x10]
    assert frame.rgb[5, 5].tolist() == [0, 0, 0]
    camera.close()


@pytest.mark.parametrize("title", ["", "red"])
def test_without_a_display_it_says_so(monkeypatch, clock, title):
    monkeypatch.setenv("DISPLAY", ":987")
    with pytest.raises(CameraError, match="no screen to capture"):
        ScreenCamera(title, clock=clock)
