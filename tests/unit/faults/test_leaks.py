"""Leftovers of a flight are found and named."""

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from faults import processes
from faults.processes import leaks, processes_with, thread_names


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
