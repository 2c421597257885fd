import gc
import os
import sys
from collections.abc import Iterator

import pytest

from mavbridge.core.realtime import SWITCH_INTERVAL_S, settle_process, settle_thread


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
    assert sys.getswitchinterval() == pytest.approx(SWITCH_INTERVAL_S)


def test_nothing_asked_nothing_changed() -> None:
    assert settle_thread(realtime=False, cpu=None) is None


def test_a_refusal_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse, raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    assert "ulimit" in (settle_thread(realtime=True, cpu=None) or "")


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no CPU affinity on this system")
def test_the_only_cpu_is_never_taken_from_the_watchdog(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    monkeypatch.setattr(os, "sched_setscheduler", lambda *given: asked.append(given))
    assert settle_thread(realtime=True, cpu=None) is None
    assert asked == []


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no CPU affinity on this system")
def test_a_cpu_that_does_not_exist_is_told() -> None:
    assert "CPU 4095" in (settle_thread(realtime=False, cpu=4095) or "")
