import os
import pty
import queue
import select
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

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


class Terminal:
    """The two ends of a terminal, and the keys that a keyboard on it has passed on."""

    def __init__(self) -> None:
        self.user, self.fd = pty.openpty()
        self.keys: queue.Queue[str] = queue.Queue()
        self.keyboard = Keyboard(self.keys.put, fd=self.fd)

    def type(self, keys: bytes) -> None:
        os.write(self.user, keys)

    def until(self, last: str) -> list[str]:
        """The next keys, up to this one."""
        got = [self.keys.get(timeout=30.0)]
        while got[-1] != last:
            got.append(self.keys.get(timeout=30.0))
        return got

    def local_modes(self) -> int:
        return termios.tcgetattr(self.fd)[LOCAL_MODES]

    def start(self) -> None:
        assert self.keyboard.start()
        for _ in range(600):
            if not self.local_modes() & termios.ICANON:
                return
            select.select([], [], [], 0.05)
        raise AssertionError("the terminal did not leave its canonical mode")


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    """Is afterwards as it was before."""
    made = Terminal()
    before = termios.tcgetattr(made.fd)
    yield made
    made.keyboard.stop(30.0)
    made.keyboard.stop(30.0)
    with suppress(OSError, termios.error):  # the user may have hung up
        assert termios.tcgetattr(made.fd) == before
        os.close(made.user)
    os.close(made.fd)


def test_keys_come_singly_without_echo_and_control_c_stays_a_signal(terminal: Terminal) -> None:
    terminal.type(b"e\n")  # before the flight
    terminal.start()
    assert not terminal.local_modes() & termios.ECHO
    assert terminal.local_modes() & termios.ISIG
    while select.select([terminal.user], [], [], 0)[0]:
        os.read(terminal.user, 100)  # the echo of what was typed before
    for key, expected in ((b"q", "q"), (b"e", "e"), (b"E", "e")):
        terminal.type(key)
        assert terminal.keys.get(timeout=30.0) == expected
    terminal.keyboard.stop(30.0)
    assert select.select([terminal.user], [], [], 0)[0] == []  # nothing was echoed


@pytest.mark.parametrize(
    ("typed", "expected"),
    [(b"x", []), (b"\x1be", []), (b"\x1bOq", []), (b"the end\n", []), (b"ee", ["e"])],
)
def test_a_paste_or_a_function_key_engages_nothing(
    terminal: Terminal, typed: bytes, expected: list[str]
) -> None:
    terminal.start()
    terminal.type(typed)
    for _ in range(600):  # until it was read
        if not terminal.keys.empty() or not select.select([terminal.fd], [], [], 0)[0]:
            break
        select.select([], [], [], 0.05)
    terminal.type(b"q")
    assert terminal.until("q") in ([*expected, "q"], ["q"])


def test_a_release_among_other_keys_counts(terminal: Terminal) -> None:
    terminal.start()
    terminal.type(b"eq")
    terminal.until("q")


def test_the_end_of_the_terminal_ends_the_thread(terminal: Terminal) -> None:
    terminal.start()
    os.close(terminal.user)
    terminal.keyboard.stop(30.0)


def test_without_a_terminal_nothing_is_read(tmp_path: Path) -> None:
    file = tmp_path / "input"
    file.write_text("e")
    with file.open() as stream:
        keyboard = Keyboard(pytest.fail, fd=stream.fileno())
        assert not keyboard.start()
        keyboard.stop(0.0)
        assert stream.read() == "e"


def test_a_job_in_the_background_is_not_stopped(terminal: Terminal) -> None:
    command = [sys.executable, "-c", JOB, os.ttyname(terminal.fd)]
    job = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    terminal.type(b"e\n")
    output, _ = job.communicate("end\n", timeout=60.0)
    assert output == "0\n"
