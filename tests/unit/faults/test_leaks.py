"""Leftovers of a flight are found and named."""

import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from faults import processes, steps
from faults.processes import leaks, processes_with, thread_names
from helpers.fakes import FakeClock


def test_a_process_a_thread_memory_and_a_file_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "LEFT_WAIT_S", 0.0)
    monkeypatch.setattr(processes, "MEMORY", tmp_path)
    (tmp_path / "psm_test").touch()
    before, end = thread_names(), threading.Event()
    thread = threading.Thread(target=end.wait, name="left-over")
    thread.start()
    variable = f"FAULTS_TEST={tmp_path}"
    with subprocess.Popen(
        [sys.executable, "-c", "import sys; print(flush=True); sys.stdin.read()"],
        env={"FAULTS_TEST": str(tmp_path)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        process.stdout.readline()
        try:
            left = leaks(lambda: processes_with(variable), {"psm_test"}, tmp_path, before)
        finally:
            end.set()
            thread.join()
            process.communicate()
    assert left[0].startswith(f"process {process.pid}: ")
    assert left[1:] == ["shared memory psm_test", "temporary psm_test", "thread left-over"]


def test_a_load_that_is_interrupted_leaves_no_program_behind(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupt(_s: float) -> None:
        raise KeyboardInterrupt

    hogs: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen
    monkeypatch.setattr(
        subprocess, "Popen", lambda command: hogs.append(start(command)) or hogs[-1]
    )
    with pytest.raises(KeyboardInterrupt):
        steps.load(SimpleNamespace(clock=FakeClock(), observe=interrupt), s=1.0)
    assert [hog.returncode for hog in hogs] == [-9] * len(hogs) != []
