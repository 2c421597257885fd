"""How the threads of a flight are ended."""

import threading

import pytest

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.workers import HungError, Worker
from mavbridge.flight import app


def ending(worker, *, hang_s, has_hung=False):
    flight = object.__new__(app._Flight)
    flight._hang_ns, flight._encoder_hang_ns = hang_s * NS_PER_S, 0
    flight._has_hung = has_hung
    flight._join(worker)


@pytest.fixture
def may_end():
    event = threading.Event()
    yield event
    event.set()


def solving(may_end):
    """A policy in a solve that goes on after it was told to stop."""
    worker = Worker("test-solving", lambda _stop: may_end.wait())
    worker.start()
    return worker


def test_a_slow_policy_ends_its_solve(monkeypatch, may_end):
    monkeypatch.setattr(app, "JOIN_S", 0.01)
    worker = solving(may_end)
    threading.Timer(0.1, may_end.set).start()
    ending(worker, hang_s=20)
    assert not worker.is_alive


def test_a_policy_that_does_not_end_is_an_error_that_is_told_once(monkeypatch, may_end):
    monkeypatch.setattr(app, "JOIN_S", 0.01)
    worker = solving(may_end)
    with pytest.raises(HungError):
        ending(worker, hang_s=0)
    ending(worker, hang_s=20, has_hung=True)  # reported already
    assert worker.is_alive
