"""The log of a run: what goes to the file, what to the terminal, and that nobody waits for it."""

import logging
import sys
import threading
from pathlib import Path

import pytest

from mavbridge.core import log
from mavbridge.core.errors import PeerError
from mavbridge.core.log import SAID, run_log

SPOKEN, DETAIL = logging.getLogger(SAID), logging.getLogger("mavbridge.somewhere")


def speak() -> None:
    SPOKEN.info("FLYING")
    DETAIL.debug("a detail")
    logging.getLogger("other.library").debug("chatter")
    logging.getLogger("other.library").warning("trouble")


@pytest.mark.parametrize("verbose", [True, False])
def test_the_file_gets_all_of_ours_and_the_terminal_what_it_has_not_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], verbose: bool
) -> None:
    path = tmp_path / "logs" / "run.log"
    with run_log(path, verbose=verbose):
        speak()
    text, shown = path.read_text(), capsys.readouterr().err
    for words in ("command: mavbridge", "versions: mavbridge", "FLYING", "a detail", "trouble"):
        assert words in text
    assert ("chatter" in text, "FLYING" in shown, "chatter" in shown) == (False, False, False)
    assert "a detail\ntrouble\n" in shown if verbose else shown == "trouble\n"
    assert not [t for t in threading.enumerate() if t.name == log.THREAD]


def test_runs_are_added_with_their_errors_and_the_traceback_of_a_bug(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    for error in (PeerError("no vehicle"), ZeroDivisionError("by zero")):
        with pytest.raises(type(error)), run_log(path, verbose=False):
            raise error
    text = path.read_text()
    assert "ERROR   mavbridge.said: no vehicle" in text
    assert "Traceback" in text
    assert "ZeroDivisionError: by zero" in text


def test_neither_an_odd_name_nor_a_closed_terminal_ends_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.log"
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", None)
        patch.setattr(logging.getLogger(), "handlers", [])  # pytest-xdist cannot send the name
        with run_log(path, verbose=True):
            DETAIL.debug("no file caf\udcff")
            speak()
    assert r"no file caf\udcff" in path.read_text()
    assert "trouble" in path.read_text()


def test_what_does_not_fit_is_dropped_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log, "CAPACITY", 5)
    monkeypatch.setattr(log, "CLOSE_S", 30.0)
    entered, leave = threading.Event(), threading.Event()

    def hold(_record: logging.LogRecord) -> bool:
        entered.set()
        return leave.wait(30)

    monkeypatch.setattr(log, "_begin", lambda: None)
    monkeypatch.setattr(log._Terminal, "filter", lambda self, record: hold(record))
    path = tmp_path / "run.log"
    with run_log(path, verbose=True):
        DETAIL.debug("first")
        assert entered.wait(30)
        for number in range(9):
            DETAIL.debug("later %d", number)  # returns at once, also where there is no room
        leave.set()
    text = path.read_text()
    assert "4 records were dropped" in text
    assert ("later 4" in text, "later 5" in text) == (True, False)


def test_without_a_flag_logging_stays_as_it_was() -> None:
    before = list(logging.getLogger().handlers)
    with run_log(None, verbose=False):
        assert logging.getLogger().handlers == before
