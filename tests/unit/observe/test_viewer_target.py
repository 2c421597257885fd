import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from mavbridge.core import processes
from mavbridge.core.errors import MavbridgeError, PeerError, UserError
from mavbridge.core.processes import free_port
from mavbridge.observe import viewer_target
from mavbridge.observe.viewer import RerunView
from mavbridge.observe.viewer_layout import ViewedFlight
from mavbridge.observe.viewer_target import check_target, prepare_target, spawn_viewer

LISTENS_UNTIL_KILLED = """
import socket, sys
server = socket.create_server(("127.0.0.1", int(sys.argv[sys.argv.index("--port") + 1])))
while True:
    server.accept()
"""


@pytest.fixture
def bound_port() -> Iterator[int]:
    """A port that nobody else can take, and on which nothing listens."""
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        yield bound.getsockname()[1]


def test_a_file_that_was_cut_short_is_named(tmp_path: Path) -> None:
    facts = ViewedFlight(vision_hz=30, chunk_hz=100, stick_hz=100)
    view = RerunView(str(tmp_path / "full.rrd"), facts)
    view._stream = Mock()
    view._stream.flush.side_effect = RuntimeError("File-writer thread shut down")
    with pytest.raises(MavbridgeError, match=r"full\.rrd is not complete .*: make room"):
        view.close()


def test_a_file_is_tried_and_not_left_behind(tmp_path: Path) -> None:
    path = tmp_path / "flight.rrd"
    assert prepare_target(str(path)) == path
    assert not path.exists()
    path.write_text("an older flight")
    check_target(str(path))
    assert path.read_text() == "an older flight"


CHOICES = r"spawn, connect, connect=URL, FILE\.rrd, off"
EXAMPLE = r"look like rerun\+http://127\.0\.0\.1:9876/proxy"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        *(("", CHOICES), ("Spawn", CHOICES), ("flight.mp4", CHOICES)),
        ("http://127.0.0.1:9876", CHOICES),
        ("connect=http://127.0.0.1:9876/proxy", EXAMPLE),
        ("connect=rerun+http://127.0.0.1/proxy", EXAMPLE),
        ("connect=rerun+http://:9876/proxy", EXAMPLE),
        ("connect=rerun+http://127.0.0.1:9876", EXAMPLE),
        ("connect=rerun+http://127.0.0.1:99999/proxy", EXAMPLE),
    ],
)
def test_a_target_that_is_none_is_refused_with_what_would_be_one(text: str, told: str) -> None:
    with pytest.raises(UserError, match=told):
        prepare_target(text)


def test_a_viewer_is_accepted_if_it_listens(bound_port: int) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"rerun+http://127.0.0.1:{server.getsockname()[1]}/proxy"
        assert prepare_target(f"connect={url}") == url
    with pytest.raises(PeerError, match=f"no Rerun viewer listens at .*:{bound_port}/proxy"):
        prepare_target(f"connect=rerun+http://127.0.0.1:{bound_port}/proxy")


def test_a_spawned_viewer_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port(socket.SOCK_STREAM)
    monkeypatch.setattr(viewer_target, "SETTLE_S", 0.05)
    spawned = spawn_viewer([sys.executable, "-c", LISTENS_UNTIL_KILLED], port=port)
    assert spawned.poll() is None
    socket.create_connection(("127.0.0.1", port), 10).close()
    spawned.kill()
    spawned.wait(10)


def test_a_spawned_viewer_that_never_listens_is_ended(
    bound_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viewer_target, "SPAWN_TIMEOUT_S", 2.0)
    monkeypatch.setattr(processes, "END_TIMEOUT_S", 0.1)
    spawned: list[subprocess.Popen[bytes]] = []

    def spawn(*args: Any, **kwargs: Any) -> subprocess.Popen[bytes]:
        spawned.append(popen(*args, **kwargs))
        return spawned[0]

    popen = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", spawn)
    stubborn = "import signal; signal.signal(15, signal.SIG_IGN); signal.pause()"
    with pytest.raises(MavbridgeError, match="did not listen within 2 s; record to a file"):
        spawn_viewer([sys.executable, "-c", stubborn], port=bound_port)
    assert spawned[0].poll() is not None


def test_a_spawned_viewer_that_ends_is_reported_with_its_last_words(bound_port: int) -> None:
    dies = "import sys; sys.exit('starting up\\nno display is set')"
    with pytest.raises(MavbridgeError, match="exited at once: no display is set; record to a file"):
        spawn_viewer([sys.executable, "-c", dies], port=bound_port)
