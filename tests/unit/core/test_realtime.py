import gc
import os
import platform
import sys
from collections.abc import Iterator
from unittest.mock import Mock

import pytest

from helpers.programs import ended
from mavbridge.core.errors import UserError
from mavbridge.core.realtime import (
    ACTION_FIFO_PRIORITY,
    GUARD_FIFO_PRIORITY,
    SWITCH_INTERVAL_S,
    require_supported_system,
    settle_process,
    settle_thread,
)

linux = pytest.mark.skipif(platform.system() != "Linux", reason="a setting of Linux")

VICTIM = """
import resource
from mavbridge.core.realtime import prepare_to_die_first
prepare_to_die_first()
print(open("/proc/self/oom_score_adj").read().strip(), *resource.getrlimit(resource.RLIMIT_CORE))
"""

GUARD = """
import os, sys
from mavbridge.core.realtime import settle_guard
{before}
print(settle_guard(realtime=True))
policy = os.sched_getscheduler(0)
is_fifo = policy & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
print(is_fifo, bool(policy & os.SCHED_RESET_ON_FORK), os.sched_getparam(0).sched_priority)
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmLck")))
if os.fork() == 0:
    os._exit(os.sched_getscheduler(0))
print(os.waitstatus_to_exitcode(os.wait()[1]) == os.SCHED_OTHER)
print("numpy" in sys.modules)
"""

WITHOUT_RIGHTS = """
import ctypes, resource
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
resource.setrlimit(resource.RLIMIT_MEMLOCK, (2**16, 2**16))
if os.getuid() == 0:
    os.setuid(65534)
"""


def printed_by(program: str) -> list[str]:
    """Lines of a process of its own, since these settings cannot be taken back."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    done = ended(sys.executable, "-c", program, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.fixture
def restored() -> Iterator[None]:
    interval_s = sys.getswitchinterval()
    yield
    sys.setswitchinterval(interval_s)
    gc.unfreeze()


@pytest.mark.usefixtures("restored")
def test_the_process_is_settled() -> None:
    settle_process()
    assert gc.get_freeze_count() > 0
    assert gc.isenabled()
    assert sys.getswitchinterval() == pytest.approx(SWITCH_INTERVAL_S)


@linux
def test_the_flight_process_is_the_first_victim_and_leaves_no_core_dump() -> None:
    assert printed_by(VICTIM) == ["500 0 0"]


@linux
def test_the_guard_has_real_time_and_locked_memory_or_says_what_it_lacks() -> None:
    refusal, scheduling, locked_kb, is_child_ordinary, has_numpy = printed_by(
        GUARD.format(before="")
    )
    if "real-time" not in refusal:
        assert scheduling == f"True True {GUARD_FIFO_PRIORITY}"
    assert ("not locked" in refusal) == (locked_kb == "0")
    assert is_child_ordinary == "True"
    assert has_numpy == "False"


@linux
def test_a_guard_without_rights_says_how_to_allow_what_it_lacks() -> None:
    refusal, scheduling, locked_kb, *_ = printed_by(GUARD.format(before=WITHOUT_RIGHTS))
    assert "ulimit -r 10" in refusal
    assert "(Operation not permitted): allow it with ulimit -l unlimited" in refusal
    assert scheduling == "False False 0"
    assert locked_kb == "0"


def test_where_there_is_no_fifo_the_refusal_names_the_system(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("SCHED_RESET_ON_FORK", "sched_getaffinity"):
        monkeypatch.delattr(os, name, raising=False)
    monkeypatch.setattr(platform, "system", lambda: "Darwin")
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    assert "Darwin has no SCHED_FIFO" in (settle_thread() or "")


def test_windows_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "system", lambda: "Windows")
    with pytest.raises(UserError, match="does not fly from Windows: use Linux"):
        require_supported_system()


@linux
def test_the_action_loop_is_below_the_guard_and_never_takes_the_only_cpu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[int, int, object]] = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda *given: asked.append(given))
    for cpus in ({0}, {0, 1}):
        assert asked == []
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, cpus=cpus: cpus)
        assert settle_thread() is None
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    assert asked == [(0, policy, os.sched_param(ACTION_FIFO_PRIORITY))]
    assert ACTION_FIFO_PRIORITY < GUARD_FIFO_PRIORITY
    monkeypatch.setattr(os, "sched_setscheduler", Mock(side_effect=PermissionError))
    assert "ulimit" in (settle_thread() or "")
