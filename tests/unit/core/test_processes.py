import sys
from pathlib import Path

import pytest

from helpers.programs import ended
from mavbridge.core import processes
from mavbridge.core.processes import child_environment, end, free_port, log_tail, running

pytestmark = pytest.mark.system
DEAF = """
import signal, threading
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("here", flush=True)
threading.Event().wait()
"""


def test_a_process_that_failed_is_quoted(tmp_path: Path) -> None:
    log = tmp_path / "log"
    with running(sys.executable, "-c", "print('boom'); exit(3)", log=log) as process:
        assert process.wait(30) == 3
    assert log_tail(log) == "boom"


def test_a_process_that_will_not_end_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "END_TIMEOUT_S", 0.5)
    log = tmp_path / "log"
    with running(sys.executable, "-c", DEAF, log=log) as process:
        while b"here" not in log.read_bytes():
            assert process.poll() is None
    assert process.poll() is not None
    end(process)  # once more is harmless


def test_a_child_imports_this_mavbridge_wherever_it_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mavbridge.py").write_text("raise RuntimeError('another mavbridge')")
    monkeypatch.chdir(tmp_path)
    log = tmp_path / "log"
    program = "import mavbridge; print(mavbridge.__file__)"
    with running(sys.executable, "-c", program, log=log) as process:
        assert process.wait(30) == 0
    assert log.read_text().strip() == processes.mavbridge.__file__


def test_no_port_is_given_twice_by_two_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    first = free_port()
    ports = range(first, first + 8)
    monkeypatch.setattr(processes, "PORTS_TO_GIVE", ports)
    ours = {first, free_port(), free_port()}
    asks = (
        f"from mavbridge.core import processes\nprocesses.PORTS_TO_GIVE = {ports}\n"
        "while True: print(processes.free_port(), flush=True)"
    )
    child = ended(sys.executable, "-c", asks, env=child_environment())
    theirs = {int(line) for line in child.stdout.split()}
    assert len(ours) == 3
    assert theirs
    assert not theirs & ours
    assert f"ports {ports[0]} to {ports[-1]} is free" in child.stderr
