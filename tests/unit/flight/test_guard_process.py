"""The death of the guard, seen by the flight process, which then sends the last words."""

import os
import select
import signal
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from helpers.factories import make_guard_tick
from helpers.fakes import START_NS, FakeClock
from helpers.wire import needs_ipv6
from mavbridge.config.flight import FlyConfig, LinkConfig
from mavbridge.config.policy import Rates
from mavbridge.core.address import SocketAddress
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.link_settings import LinkSettings
from mavbridge.flight import guard_process
from mavbridge.flight.guard_process import (
    CLOSE_S,
    LATEST_NS,
    SILENT_WAITS,
    GuardProcess,
    start_guard,
)
from mavbridge.guard.channel import SocketPort
from mavbridge.guard.values import GuardSettings, Phase
from mavbridge.guard.wire import GuardDiedError, LastWords, encode

MS = NS_PER_MS
PACKETS = ((0, b"neutral"), (20 * MS, b"neutral"), (100 * MS, b"mode"))
WHOLE = [b"neutral", b"neutral", b"mode"]


class Child:
    """The guard's process, which is gone when it is killed."""

    pid, returncode = 4321, None
    kill: Callable[[], None]

    def wait(self, timeout_s: float) -> int:
        if self.returncode is None:
            raise subprocess.TimeoutExpired("guard", timeout_s)
        return self.returncode


class View:
    def receive(self, message: Any) -> None:
        pass


@dataclass
class Rig:
    """A flight process, and the guard's end of the channel."""

    clock: FakeClock = field(default_factory=FakeClock)
    child: Any = field(default_factory=Child)
    port: Any = None
    guard: Any = None

    def tell(
        self,
        phase: Phase = Phase.FLYING,
        fd: int | None = None,
        receiver: SocketAddress | None = None,
        packets: tuple[tuple[int, bytes], ...] = PACKETS,
    ) -> None:
        words = LastWords(phase, "BRAKE", receiver, fd is not None, packets)
        assert self.port.send(encode(words), fd)

    def tick(self, phase: Phase = Phase.FLYING) -> None:
        self.port.send(encode(make_guard_tick(self.clock.now_ns(), phase=phase)))

    def die(self, returncode: int | None = -9) -> str:
        """Returns what the user is told."""
        self.child.returncode = returncode
        self.port.close()
        with pytest.raises(GuardDiedError) as told:
            self.guard.listen(threading.Event(), View())
        return str(told.value)


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[Rig]:
    made, set_params = Rig(), getattr(request, "param", ())

    def spawn(ends: tuple[socket.socket, socket.socket], _settings: GuardSettings) -> Any:
        made.port = SocketPort(ends[0].dup())
        return made.child

    monkeypatch.setattr(guard_process, "_spawn", spawn)
    link = LinkSettings(connect="udp:127.0.0.1:1", set_params=set_params)
    made.guard = GuardProcess(GuardSettings(link=link), made.clock)
    yield made
    made.port.close()
    made.child.returncode = 0
    made.guard.close()


@dataclass
class Link:
    """The guard's open socket or port, and the vehicle's end."""

    fd: int
    receiver: SocketAddress | None
    heard: Callable[[], list[bytes]]
    close: Callable[[], None]


def udp(host: str = "127.0.0.1") -> Link:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    ours = socket.socket(family, socket.SOCK_DGRAM)
    vehicle = socket.socket(family, socket.SOCK_DGRAM)
    for end in (ours, vehicle):
        end.bind((host, 0))
        end.setblocking(False)
    port = ours.getsockname()

    def heard() -> list[bytes]:
        received = []
        while True:
            try:
                data, sender = vehicle.recvfrom(100)
            except BlockingIOError:
                return received
            assert sender == port
            received.append(data)

    return Link(ours.detach(), vehicle.getsockname(), heard, vehicle.close)


def udp_over_ipv6() -> Link:
    return udp("::1")


def tcp() -> Link:
    server = socket.create_server(("127.0.0.1", 0))
    ours = socket.create_connection(server.getsockname())
    vehicle = server.accept()[0]
    server.close()
    return Link(ours.detach(), None, lambda: [vehicle.recv(100)], vehicle.close)


@pytest.fixture(params=[udp, pytest.param(udp_over_ipv6, marks=needs_ipv6), tcp])
def link(request: pytest.FixtureRequest) -> Iterator[Link]:
    made: Link = request.param()
    yield made
    made.close()


def test_the_last_words_leave_by_the_link_of_a_guard_that_is_gone(rig: Rig, link: Link) -> None:
    rig.tell(fd=link.fd, receiver=link.receiver)
    os.close(link.fd)  # the guard's own dies with it
    rig.tick()
    text = rig.die()
    assert b"".join(link.heard()) == b"".join(WHOLE)
    assert rig.clock.now_ns() == START_NS + 100 * MS
    assert "signal 9" in text
    assert "BRAKE" in text


@pytest.mark.parametrize("rig", [(), (("GUID_OPTIONS", 8.0),)], indirect=True)
def test_what_set_has_changed_is_told_to_stay_as_a_dead_guard_left_it(
    rig: Rig, request: pytest.FixtureRequest
) -> None:
    is_set = bool(request.node.callspec.params["rig"])
    assert rig.die().endswith("; what --set has changed stays so") is is_set


def test_newer_words_replace_those_before_and_keep_the_link(rig: Rig, link: Link) -> None:
    rig.tell(fd=link.fd, receiver=link.receiver)
    os.close(link.fd)
    rig.tell(receiver=link.receiver, packets=((0, b"newer"),))
    rig.tick()
    rig.die()
    assert b"".join(link.heard()) == b"newer"


def test_a_fork_of_the_policy_does_not_hide_the_death_of_the_flight_process(rig: Rig) -> None:
    child = os.fork()
    if child == 0:
        signal.pause()
    try:
        rig.guard.close()
        while not rig.port.is_closed:
            assert select.select([rig.port], [], [], 10.0)[0]
            rig.port.receive()
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


@pytest.mark.parametrize(
    "case", ["holds", "prepares", "released", "heard", "too late", "knows no words"]
)
def test_a_guard_that_stands_still_is_killed_if_its_last_words_can_be_sent(
    rig: Rig, case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    link, stop, waits, waited_s = udp(), threading.Event(), 0, list[float]()
    phase = {"prepares": Phase.PREPARING, "released": Phase.RELEASED}.get(case, Phase.FLYING)
    told = Phase.FLYING if case == "released" else phase
    if case != "knows no words":
        rig.tell(told, fd=link.fd, receiver=link.receiver)
        os.close(link.fd)
    rig.tick(phase)
    if case == "too late":
        rig.clock.advance_ns(LATEST_NS + MS)

    def wait_in_vain(*ends: Any) -> Any:
        nonlocal waits
        waits += 1
        if case == "heard" and waits == SILENT_WAITS:
            rig.tell(told, receiver=link.receiver, packets=PACKETS[1:])  # the rest of its own words
        if waits == 2 * SILENT_WAITS:
            stop.set()
        return real_select(*ends[:3], 0.0)

    def kill() -> None:
        rig.child.returncode = -9
        rig.port.close()

    real_select, rig.child.kill = select.select, kill
    monkeypatch.setattr(select, "select", wait_in_vain)
    if case == "too late":  # the user is told at once, and a guard that goes on ends the flight
        with pytest.raises(
            GuardDiedError, match=r"4321\) stands still: silent for 0\.5 s, too long"
        ):
            rig.guard.listen(stop, View())
        assert rig.child.returncode is None
        assert link.heard() == []
        rig.child.wait = lambda timeout_s: waited_s.append(timeout_s) or 0
        rig.guard.close()
        assert waited_s == [0.0]
    elif case not in ("holds", "prepares"):
        rig.guard.listen(stop, View())
        assert link.heard() == []
    else:
        with pytest.raises(GuardDiedError, match=r"killed after 0\.3 s in which it stood still"):
            rig.guard.listen(stop, View())
        assert b"".join(link.heard()) == b"".join(WHOLE)
    link.close()


@pytest.mark.parametrize(
    ("phase", "waited_s"), [(Phase.RELEASED, CLOSE_S), (Phase.LEAVING, CLOSE_S), (Phase.HOLDING, 0)]
)
def test_a_guard_that_holds_sticks_is_not_waited_for(
    rig: Rig, phase: Phase, waited_s: float
) -> None:
    rig.tick(phase)
    stop, told_s = threading.Event(), list[float]()
    view = SimpleNamespace(receive=lambda _: stop.set())
    rig.guard.listen(stop, view)
    rig.child.wait = lambda timeout_s: told_s.append(timeout_s) or 0
    rig.guard.close()
    assert told_s == [waited_s]


@pytest.mark.parametrize("case", ["released", "given back", "old", "alive", "a bug", "silent"])
def test_nothing_is_sent_where_it_would_be_wrong(rig: Rig, case: str) -> None:
    link = udp()
    rig.tell(fd=link.fd, receiver=link.receiver)
    os.close(link.fd)
    if case != "silent":
        rig.tick()
    if case == "released":
        rig.tell(Phase.RELEASED, packets=())
    elif case == "given back":  # and the newer words did not get through
        rig.tick(Phase.RELEASED)
    elif case == "old":
        rig.clock.advance_ns(LATEST_NS + MS)
    if case == "a bug":  # it has said them itself
        rig.port.send(encode(GuardDiedError("Traceback")))
    text = rig.die(None if case == "alive" else -9)
    assert link.heard() == []
    assert ("its own timeout" in text) == (case in ("old", "alive"))
    link.close()


def test_the_duplicate_is_closed_as_soon_as_nothing_is_held(rig: Rig) -> None:
    link = tcp()
    rig.tell(fd=link.fd)
    os.close(link.fd)
    rig.tell(Phase.RELEASED, packets=())
    rig.tick(Phase.RELEASED)
    rig.die()
    assert link.heard() == [b""]  # the vehicle sees the end of the connection
    link.close()


def test_a_guard_that_ended_in_order_unheard_is_not_called_dead(rig: Rig) -> None:
    """Its summary does not fit into the channel of a process that was stopped for long."""
    rig.tick(Phase.RELEASED)
    assert rig.die(returncode=0) == "the guard ended the flight while this process stood still"


def test_the_process_is_told_what_the_flags_say(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[GuardSettings] = []

    def spawn(_ends: tuple[socket.socket, socket.socket], settings: GuardSettings) -> Any:
        told.append(settings)
        child = Child()
        child.returncode = 0
        return child

    monkeypatch.setattr(guard_process, "_spawn", spawn)
    link, rates = LinkConfig(connect="udp:127.0.0.1:1"), Rates(realtime=False)
    with ExitStack() as stack:
        start_guard(FlyConfig(link=link, rates=rates), FakeClock(), stack)
        start_guard(FlyConfig(link=link, record=Path("flight")), FakeClock(), stack)
    unrecorded, recorded = told
    assert (unrecorded.realtime, unrecorded.tlog_fd, unrecorded.keeps_packets) == (
        False,
        None,
        False,
    )
    assert (recorded.realtime, recorded.keeps_packets) == (True, True)
    assert recorded.tlog_fd is not None
