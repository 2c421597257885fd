import os
import pty
import queue
import select
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mavbridge.observe.keyboard import Keyboard

LOCAL_MODES = 3
JOB = """
import os, signal, sys, time
from mavbridge.observe.keyboard import POLL_S, Keyboard

os.setsid()
terminal = os.open(sys.argv[1], os.O_RDWR)  # the controlling terminal from here on
signal.signal(signal.SIGTTOU, signal.SIG_IGN)
leader = os.getpgrp()
if os.fork() == 0:
    signal.signal(signal.SIGTTOU, signal.SIG_DFL)
    os.setpgid(0, 0)  # a job in the background
    pressed = []
    keyboard = Keyboard(pressed.append, fd=terminal)
    keyboard.start()
    sys.stdin.readline()
    time.sleep(3 * POLL_S)  # enough to be stopped, if it were to happen
    assert pressed == [], pressed
    keyboard.stop(30.0)
    os._exit(0)
_, status = os.waitpid(-1, os.WUNTRACED)
print("stopped" if os.WIFSTOPPED(status) else os.waitstatus_to_exitcode(status))
"""


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    """The two ends of a terminal: the user's and the process's."""
    ends = pty.openpty()
    yield ends
    for end in ends:
        os.close(end)


class Pressed:
    """Keys that a keyboard has passed on."""

    def __init__(self) -> None:
        self.keys: queue.Queue[str] = queue.Queue()

    def next(self) -> str:
        return self.keys.get(timeout=30.0)


def started(fd: int, pressed: Pressed, **keys: Any) -> Keyboard:
    keyboard = Keyboard(pressed.keys.put, fd=fd, **keys)
    assert keyboard.start()
    for _ in range(600):
        if not local_modes(fd) & termios.ICANON:
            return keyboard
        select.select([], [], [], 0.05)
    raise AssertionError("the terminal did not leave its canonical mode")


def local_modes(fd: int) -> int:
    return termios.tcgetattr(fd)[LOCAL_MODES]


def test_keys_come_singly_without_echo_and_control_c_stays_a_signal(
    terminal: tuple[int, int],
) -> None:
    user, fd = terminal
    before = termios.tcgetattr(fd)
    pressed = Pressed()
    keyboard = started(fd, pressed)
    assert not local_modes(fd) & termios.ECHO
    assert local_modes(fd) & termios.ISIG
    for key, expected in ((b"e", "e"), (b"q", "q"), (b"E", "e")):
        os.write(user, key)
        assert pressed.next() == expected
    keyboard.stop(30.0)
    keyboard.stop(30.0)
    assert termios.tcgetattr(fd) == before
    assert select.select([user], [], [], 0)[0] == []  # nothing was echoed


@pytest.mark.parametrize(
    ("typed", "expected"),
    [(b"x", []), (b"\x1be", []), (b"\x1bOq", []), (b"the end\n", []), (b"ee", ["e"])],
)
def test_a_paste_or_a_function_key_engages_nothing(
    terminal: tuple[int, int], typed: bytes, expected: list[str]
) -> None:
    user, fd = terminal
    pressed = Pressed()
    keyboard = started(fd, pressed)
    os.write(user, typed)
    for _ in range(600):  # until it was read
        if not pressed.keys.empty() or not select.select([fd], [], [], 0)[0]:
            break
        select.select([], [], [], 0.05)
    os.write(user, b"q")
    got = [pressed.next()]
    while got[-1] != "q":
        got.append(pressed.next())
    keyboard.stop(30.0)
    assert got in ([*expected, "q"], ["q"])


def test_what_was_typed_before_the_flight_does_not_engage(terminal: tuple[int, int]) -> None:
    user, fd = terminal
    os.write(user, b"e\n")
    pressed = Pressed()
    keyboard = started(fd, pressed)
    os.write(user, b"q")
    assert pressed.next() == "q"
    keyboard.stop(30.0)


def test_a_failing_receiver_leaves_the_terminal_as_it_was(terminal: tuple[int, int]) -> None:
    user, fd = terminal
    before = termios.tcgetattr(fd)
    called = queue.Queue[str]()

    def fail(key: str) -> None:
        called.put(key)
        raise RuntimeError("no use for a key")

    keyboard = Keyboard(fail, fd=fd)
    assert keyboard.start()
    while called.empty():
        os.write(user, b"e")
        select.select([], [], [], 0.05)
    with pytest.raises(RuntimeError, match="no use for a key"):
        keyboard.stop(30.0)
    assert termios.tcgetattr(fd) == before


def test_the_end_of_the_terminal_ends_the_thread() -> None:
    user, fd = pty.openpty()
    keyboard = started(fd, Pressed())
    os.close(user)
    keyboard.stop(30.0)
    os.close(fd)


def test_without_a_terminal_nothing_is_read(tmp_path: Path) -> None:
    file = tmp_path / "input"
    file.write_text("e")
    with file.open() as stream:
        keyboard = Keyboard(pytest.fail, fd=stream.fileno())
        assert not keyboard.start()
        keyboard.stop(0.0)
        assert stream.read() == "e"


def test_a_job_in_the_background_is_not_stopped(terminal: tuple[int, int]) -> None:
    user, fd = terminal
    before = termios.tcgetattr(fd)
    job = subprocess.Popen(
        [sys.executable, "-c", JOB, os.ttyname(fd)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    os.write(user, b"e\n")
    output, _ = job.communicate("end\n", timeout=60.0)
    assert output == "0\n"
    assert termios.tcgetattr(fd) == before


def test_a_release_among_other_keys_counts(terminal: tuple[int, int]) -> None:
    user, fd = terminal
    pressed = Pressed()
    keyboard = started(fd, pressed)
    os.write(user, b"eq")
    while pressed.next() != "q":
        pass
    keyboard.stop(30.0)
