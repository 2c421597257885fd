"""Screen capture on an X server of the test's own; choosing a window needs none."""

import importlib.util
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from helpers.fakes import START_NS
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
        pytest.param(WINDOWS, "gaze", 1, id="part, other case"),
        pytest.param([*WINDOWS, Window(4, "Gazebo log")], "Gazebo", 1, id="exact beats part"),
        pytest.param([Window(7, "Sim"), Window(8, "Sim")], "Sim", 8, id="frame and its window"),
        (WINDOWS, "Unity", "no window has 'Unity'.*'Gazebo', 'Terminal 1', 'Terminal 2'"),
        (WINDOWS, "terminal", "several windows have .*there are: 'Terminal 1', 'Terminal 2'"),
        ([], "Unity", "none with a title"),
    ],
)
def test_a_window_is_chosen_by_title_or_what_there_is_is_listed(windows, title, chosen):
    if isinstance(chosen, int):
        assert choose_window(windows, title).id == chosen
    else:
        with pytest.raises(UserError, match=chosen):
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


@pytest.fixture
def tell(display):
    """A red window, 100x80 at (50, 40), in a process of its own, which runs what it is told."""
    with subprocess.Popen(
        [sys.executable, "-c", RED_WINDOW], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "shown\n"

        def run(command):
            process.stdin.write(command + "\n")
            process.stdin.flush()
            assert process.stdout.readline() == "done\n"

        yield run
        process.stdin.close()


@needs_x
@pytest.mark.system
@pytest.mark.parametrize(
    ("title", "gone"),
    [
        ("Red μ window", "window.withdraw()"),
        ("red", "window.geometry('+1000+0')"),
        ("red", GONE),
        ("", None),
    ],
)
def test_a_window_is_captured_in_rgb_at_a_pace_until_it_goes_away(tell, clock, title, gone):
    """An empty title is the whole screen."""
    camera = ScreenCamera(title, clock=clock)
    frame = camera.read(0)
    assert (frame.frame_id, frame.captured_ns) == (1, START_NS)
    assert frame.rgb.dtype == np.uint8
    assert not frame.rgb.flags.writeable
    if title:
        assert frame.rgb.shape == (80, 100, 3)
        assert np.unique(frame.rgb.reshape(-1, 3), axis=0).tolist() == [[0xFF, 0x20, 0x10]]
    else:
        assert frame.rgb.shape == (240, 320, 3)
        assert frame.rgb[[80, 5], [100, 5]].tolist() == [[0xFF, 0x20, 0x10], [0, 0, 0]]
    assert camera.read(NS_PER_MS) is None
    assert clock.now_ns() == START_NS + NS_PER_MS
    assert camera.read(NS_PER_S).captured_ns == START_NS + INTERVAL_NS
    if gone:
        tell(gone)
        with pytest.raises(CameraError, match="closed, hidden or moved off"):
            camera.read(NS_PER_S)
    camera.close()
    camera.close()


@pytest.mark.parametrize("title", ["", "red"])
def test_without_a_display_it_says_so(monkeypatch, clock, title):
    monkeypatch.setenv("DISPLAY", ":987")
    with pytest.raises(CameraError, match="no screen to capture"):
        ScreenCamera(title, clock=clock)
