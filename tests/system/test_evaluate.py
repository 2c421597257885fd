"""Evaluation as a process of its own."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.stopping import INTERRUPTED, ONE_REQUEST_NS

POLICY = """
import os
import threading
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from policy.contract import Contract


class Single:
    contract = Contract(arrays="numpy")

    def predict(self, image, state, history, steps):
        return np.zeros((1, 16, 4), np.float32)


class Untidy(Single):
    def __init__(self):
        os.chdir("/")
        threading.Thread(target=threading.Event().wait).start()

    def predict(self, image, state, history, steps):
        ThreadPoolExecutor().submit(threading.Event().wait)
        return super().predict(image, state, history, steps)


class Hanging(Single):
    instances = 0

    def __init__(self):
        Hanging.instances += 1

    def reset(self):
        self.flies = True

    def predict(self, image, state, history, steps):
        if Hanging.instances == 2 and hasattr(self, "flies"):
            print("hangs", flush=True)
            threading.Event().wait()
        return super().predict(image, state, history, steps)
"""


def evaluation(folder: Path, policy: str, output: int, *flags: str) -> subprocess.Popen[str]:
    """Evaluate into flown.json; ``policy`` may be a class of POLICY."""
    (folder / "mine.py").write_text(POLICY)
    return subprocess.Popen(
        [
            *(sys.executable, "-m", "mavbridge", "evaluate", "--policy", policy),
            *("--max-time", "1", "--json", "flown.json", *flags),
        ],
        cwd=folder,
        stdout=output,
        stderr=output,
        text=True,
    )


@pytest.mark.parametrize("open_ends", [os.pipe, os.openpty])
def test_flights_are_written_although_the_reader_has_gone(
    tmp_path: Path, open_ends: Callable[[], tuple[int, int]]
) -> None:
    reader, writer = open_ends()
    os.close(reader)
    flying = evaluation(tmp_path, "scripted:circle", writer, "--episodes", "1")
    os.close(writer)
    assert (flying.wait(120), (tmp_path / "flown.json").exists()) == (0, True)


def test_a_policy_that_leaves_a_thread_and_another_folder_ends_in_order(tmp_path: Path) -> None:
    flying = evaluation(tmp_path, "./mine.py:Untidy", subprocess.DEVNULL, "--episodes", "1")
    try:
        assert (flying.wait(120), (tmp_path / "flown.json").exists()) == (0, True)
    finally:
        flying.kill()


def test_a_second_request_ends_a_policy_that_hangs_and_keeps_the_flights(tmp_path: Path) -> None:
    with evaluation(tmp_path, "./mine.py:Hanging", subprocess.PIPE) as flying:
        try:
            assert any("hangs" in line for line in flying.stdout)
            for _ in range(2):
                flying.send_signal(signal.SIGTERM)
                threading.Event().wait(2 * ONE_REQUEST_NS / NS_PER_S)
            flying.communicate(timeout=60)
        finally:
            flying.kill()
    assert flying.returncode == INTERRUPTED
    assert len(json.loads((tmp_path / "flown.json").read_text())["episodes"]) == 1
