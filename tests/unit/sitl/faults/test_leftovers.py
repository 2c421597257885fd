"""What a flight has left behind is found and named."""

import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from sitl.faults.stage import leftovers as module
from sitl.faults.stage.leftovers import leftovers, thread_names
from sitl.faults.stage.processes import processes_with
from sitl.faults.stage.stage import Stage


def stage_with(folder: Path, *memory: str, variable: str = "FAULTS_TEST=none") -> Stage:
    """A flight that is over, as far as ``leftovers`` looks at it."""
    over = SimpleNamespace(
        temporary=folder, memory=set(memory), processes=lambda: processes_with(variable)
    )
    return cast(Stage, over)


def test_nothing_is_left_of_a_clean_flight(tmp_path: Path) -> None:
    assert leftovers(stage_with(tmp_path, "gone"), thread_names()) == []


def test_a_process_a_thread_memory_and_a_file_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "WAIT_S", 0.0)
    monkeypatch.setattr(module, "MEMORY", tmp_path)
    (tmp_path / "psm_test").touch()
    before, end = thread_names(), threading.Event()
    thread = threading.Thread(target=end.wait, name="left-over")
    thread.start()
    script = "import sys; print(flush=True); sys.stdin.read()"
    variable = f"FAULTS_TEST={tmp_path}"
    with subprocess.Popen(
        [sys.executable, "-c", script],
        env={"FAULTS_TEST": str(tmp_path)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            left = leftovers(stage_with(tmp_path, "psm_test", variable=variable), before)
        finally:
            end.set()
            thread.join()
            process.communicate()
    assert left[0].startswith(f"process {process.pid}: ")
    assert left[1:] == ["shared memory psm_test", "temporary psm_test", "thread left-over"]
