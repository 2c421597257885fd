"""Log of a run, for ``--log-file`` and ``--verbose``, written by its own thread.

Logging never blocks: records pass through a bounded queue, and are dropped and counted when it is
full. The logger SAID takes text that the terminal has already shown.
"""

import logging
import logging.handlers
import queue
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mavbridge.core.errors import MavbridgeError
from mavbridge.core.files import require_writable
from mavbridge.core.provenance import (
    command_line,
    git_revision,
    printable,
    versions,
    without_secrets,
)
from mavbridge.core.stopping import HungError, Worker

SAID = "mavbridge.said"
THREAD = "mavbridge-log"
CAPACITY = 2000
"""Most queued records."""
POLL_S = 0.1
CLOSE_S = 2.0
OURS = ("mavbridge", "policy")
"""Loggers of which all levels are logged; of all others only warnings."""
_FORMAT = "%(asctime)s %(levelname)-7s %(name)s: %(message)s"

_log = logging.getLogger(__name__)


class _Queue(logging.handlers.QueueHandler):
    """Queues records of any thread; drops and counts records that do not fit."""

    def __init__(self) -> None:
        self.records: queue.Queue[logging.LogRecord] = queue.Queue(CAPACITY)
        super().__init__(self.records)
        self.dropped = 0

    def prepare(self, record: logging.LogRecord) -> logging.LogRecord:
        """Format the record, and mask the secrets of addresses in it."""
        prepared: logging.LogRecord = super().prepare(record)
        prepared.msg = prepared.message = without_secrets(str(prepared.msg))
        return prepared

    def enqueue(self, record: logging.LogRecord) -> None:
        """Queue the record, or drop and count it."""
        try:
            self.records.put_nowait(record)
        except queue.Full:
            self.dropped += 1


class _File(logging.FileHandler):
    """File handler that raises the error if it cannot write."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - of logging
        """Re-raise: the log's thread handles the error."""
        del record
        raise


class _Terminal(logging.Handler):
    """Writes to the current standard error, which a flight redirects to its screen."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print the record unless the terminal has already shown it."""
        if record.name != SAID:
            sys.stderr.write(f"{printable(record.getMessage())}\n")


@contextmanager
def run_log(file: Path | None, *, verbose: bool) -> Iterator[None]:
    """Log to ``file``, and with ``verbose`` show details on the terminal, while the block runs.

    Without either, Python's default logging shows warnings.

    Raises:
        UserError: the file cannot be written.
    """
    if file is None and not verbose:
        yield
        return
    require_writable(file, "--log-file")
    source, terminal = _Queue(), _Terminal(logging.DEBUG if verbose else logging.WARNING)
    sinks: list[logging.Handler] = [terminal]
    if file is not None:
        sinks.append(_File(file, encoding="utf-8", errors="backslashreplace"))
        sinks[-1].setFormatter(logging.Formatter(_FORMAT))
    root, writer = logging.getLogger(), Worker(THREAD, lambda stop: _write(source, sinks, stop))
    levels = {name: logging.getLogger(name).level for name in OURS}
    for name in OURS:
        logging.getLogger(name).setLevel(logging.DEBUG)
    root.addHandler(source)
    writer.start()
    try:
        _begin()
        yield
    except MavbridgeError as error:
        logging.getLogger(SAID).error("%s", error)
        raise
    except Exception:
        logging.getLogger(SAID).exception("a bug of mavbridge")
        raise
    finally:
        root.removeHandler(source)
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
        with suppress(HungError):  # the terminal's reader has stalled
            writer.join(CLOSE_S)


def is_log_thread() -> bool:
    """Return True in the thread that writes the log: its output is already logged."""
    return threading.current_thread().name == THREAD


def _begin() -> None:
    _log.info("command: %s", " ".join(command_line()))
    _log.debug("versions: %s", ", ".join(f"{name} {text}" for name, text in versions().items()))
    if (revision := git_revision()) is not None:
        _log.debug("git revision: %s", revision)


def _records(source: _Queue, stop: threading.Event) -> Iterator[logging.LogRecord]:
    """Yield records until the stop, and at the end the number of those that were dropped."""
    while not (stop.is_set() and source.records.empty()):
        with suppress(queue.Empty):
            yield source.records.get(timeout=POLL_S)
    if source.dropped:
        text = f"{source.dropped} records were dropped"
        yield logging.LogRecord(__name__, logging.WARNING, "", 0, text, None, None)


def _write(source: _Queue, sinks: list[logging.Handler], stop: threading.Event) -> None:
    """Pass each record to the handlers of its level; drop a handler that fails."""
    for record in _records(source, stop):
        for sink in tuple(sinks):
            try:
                if record.levelno >= sink.level:
                    sink.handle(record)
            except Exception as error:  # noqa: BLE001 - the log never ends a command
                sinks.remove(sink)
                with suppress(Exception):  # standard error may be closed, too
                    sys.stderr.write(f"the log ends here: {error}\n")
    for sink in sinks:
        with suppress(OSError):
            sink.close()
