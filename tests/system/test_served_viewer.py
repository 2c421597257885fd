"""``--serve``: a real browser loads the page, and its program connects to the flight's data."""

import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Event

import pytest

from helpers.factories import make_tick, make_vision_tick
from mavbridge.core.errors import UserError
from mavbridge.core.processes import child_environment, end, free_port
from mavbridge.observe.viewer.flight import RerunView
from mavbridge.observe.viewer.layout import ViewedFlight
from mavbridge.observe.viewer.server import ServeAddress, listens, serve_address

pytestmark = pytest.mark.system

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
FLAGS = (
    *("--headless", "--no-sandbox", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--enable-logging=stderr"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
EVIL = "http://evil.example"
DEADLINE_S = 90
"""The page is tens of megabytes of WebAssembly, which a busy machine compiles for long."""


@pytest.fixture
def address() -> ServeAddress:
    for _ in range(100):
        try:
            return serve_address(f"127.0.0.1:{free_port(socket.SOCK_STREAM)}")
        except UserError:  # the port behind it is taken
            continue
    raise AssertionError("no two free ports beside each other")


@pytest.fixture
def view(address: ServeAddress) -> Iterator[RerunView]:
    flight = ViewedFlight(vision_hz=30, chunk_hz=100, stick_hz=100)
    view = RerunView("off", flight, serve=f"{address.host}:{address.port}")
    yield view
    view.close()


def clients(port: int) -> set[str]:
    """Sockets of other processes that are connected to this port of the loopback."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    established, remote = "01", f"0100007F:{port:04X}"
    ours = set()
    for entry in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # closed meanwhile
            ours.add(str(entry.readlink()))
    found = {f"socket:[{row[9]}]" for row in rows if (row[2], row[3]) == (remote, established)}
    return found - ours


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium or Chrome, to load the page")
def test_a_browser_runs_the_viewer_and_takes_the_stream(
    view: RerunView, address: ServeAddress, tmp_path: Path
) -> None:
    view.consume([make_tick(index) for index in range(50)] + [make_vision_tick(1)])
    assert view.url is not None
    assert not clients(address.data_port)
    log = tmp_path / "browser.log"
    with log.open("wb") as out:
        command = [str(BROWSER), *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", view.url]
        browser = subprocess.Popen(command, stdout=out, stderr=out)
        try:
            # Nothing on the page but its WebAssembly connects to the port of the data.
            for _ in range(DEADLINE_S * 5):
                if clients(address.data_port):
                    break
                with suppress(subprocess.TimeoutExpired):
                    browser.wait(0.2)
            joined = clients(address.data_port)
        finally:
            end(browser)
    assert joined, log.read_text(errors="replace")[-2000:]


@pytest.mark.parametrize("service", ["WriteMessages", "ReadMessages"])
def test_pages_of_other_origins_neither_read_nor_write(
    view: RerunView, address: ServeAddress, service: str
) -> None:
    """A browser asks so before such a request, and sends none without the origin in the answer."""
    url = f"http://{address.host}:{address.data_port}"
    path = f"/rerun.sdk_comms.v1alpha1.MessageProxyService/{service}"
    for origin, is_allowed in ((f"http://127.0.0.1:{address.port}", True), (EVIL, False)):
        request = urllib.request.Request(url + path, method="OPTIONS")
        request.add_header("Origin", origin)
        request.add_header("Access-Control-Request-Method", "POST")
        request.add_header("Access-Control-Request-Headers", "content-type,x-grpc-web")
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(request, timeout=DEADLINE_S) as answer:
            allowed = answer.headers.get("Access-Control-Allow-Origin")
        assert (allowed == origin) is is_allowed


def test_the_server_ends_with_the_view(address: ServeAddress) -> None:
    flight = ViewedFlight(vision_hz=30, chunk_hz=100, stick_hz=100)
    text = f"{address.host}:{address.port}"
    view = RerunView("off", flight, serve=text)
    with pytest.raises(UserError, match="cannot listen"):
        serve_address(text)
    view.consume([make_tick(0)])
    view.close()
    serve_address(text)


LEAVES_ITS_SERVER = """
import os, sys
from mavbridge.observe.viewer.server import listens
from mavbridge.observe.viewer.server import serve_address, start_web_server

start_web_server(serve_address(sys.argv[1]))
os.kill(os.getpid(), 9)
"""


def test_the_server_ends_with_a_flight_that_was_killed(address: ServeAddress) -> None:
    text = f"{address.host}:{address.port}"
    killed = subprocess.run(
        [sys.executable, "-c", LEAVES_ITS_SERVER, text], env=child_environment(), check=False
    )
    assert killed.returncode == -signal.SIGKILL
    for _ in range(DEADLINE_S * 5):
        if not listens(address.host, address.port):
            break
        Event().wait(0.2)
    assert not listens(address.host, address.port)
