"""Attitude out of the vehicle -> sticks back in: our loop and the peers, one echoing vehicle."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from mavbridge.commands.bench.processes import PEERS_PYTHON, end, free_udp_port, running, wait
from mavbridge.commands.bench.results import (
    Link,
    LinkClient,
    link_client_from_json,
    median_percentiles,
)
from mavbridge.core.errors import UserError
from mavbridge.core.records import Percentiles

OURS = "mavbridge.commands.bench.link_process"
BARE = "bare pymavlink loop"
MAVSDK = "MAVSDK-Python 4"
PEER_S_PER_ATTITUDE = 1 / 90
"""A little slower than the peer really is."""
CONNECTING_S = 45.0


@dataclass(frozen=True, kw_only=True)
class Client:
    """One contender."""

    name: str
    command: tuple[str, ...]
    """Without the port and the place for its figures."""
    tells: bool
    """Takes ``--port`` and ``--out`` and writes a ``LinkClient``; others take what they take."""


def clients() -> tuple[tuple[Client, ...], tuple[str, ...]]:
    """Who can run here, and why the others cannot."""
    ours = (
        Client(name="mavbridge, 100 Hz clock", command=(sys.executable, "-m", OURS), tells=True),
        Client(
            name="mavbridge, --pace state",
            command=(sys.executable, "-m", OURS, "--pace", "state"),
            tells=True,
        ),
    )
    bare = Client(
        name=BARE,
        command=(sys.executable, "-m", "benchmarks.link_pymavlink", "--port"),
        tells=False,
    )
    if not PEERS_PYTHON.is_file():
        return (*ours, bare), (f"{MAVSDK}: not measured, there is no {PEERS_PYTHON} (make test)",)
    mavsdk = Client(
        name=MAVSDK,
        command=(str(PEERS_PYTHON), "-m", "benchmarks.link_mavsdk"),
        tells=False,
    )
    return (*ours, bare, mavsdk), ()


def measure(
    contenders: tuple[Client, ...], *, repeats: int, attitudes: int, say: Callable[[str], None]
) -> tuple[Link, ...]:
    """Every client ``repeats`` times, in turn; medians of the percentiles.

    Raises:
        UserError: a client or the vehicle failed; with its last words.
    """
    found: list[list[Link]] = [[] for _ in contenders]
    for repeat in range(repeats):
        for client, links in zip(contenders, found, strict=True):
            say(f"link, repeat {repeat + 1} of {repeats}: {client.name}")
            links.append(trial(client, attitudes))
    return tuple(_merge(links) for links in found)


def trial(client: Client, attitudes: int) -> Link:
    """One client, once.

    Raises:
        UserError: the client or the vehicle failed; with its last words.
    """
    port = free_udp_port()
    with TemporaryDirectory(prefix="mavbridge-bench-") as name:
        folder = Path(name)
        figures, peer_log, client_log = (
            folder / part for part in ("figures.json", "peer.log", "client.log")
        )
        own = ("--port", str(port), "--out", str(figures)) if client.tells else (str(port),)
        peer_command = (
            *(sys.executable, "-m", "benchmarks.link_peer"),
            *("--port", str(port), "--attitudes", str(attitudes)),
        )
        with (
            running(*client.command, *own, log=client_log) as process,
            running(*peer_command, log=peer_log) as peer,
        ):
            seconds = CONNECTING_S + attitudes * PEER_S_PER_ATTITUDE
            try:
                wait(peer, "python -m benchmarks.link_peer", peer_log, seconds)
            except UserError as error:
                said = client_log.read_text(errors="replace").strip()
                raise UserError(f"{client.name}: {error}\nthe client said: {said}") from error
            end(process)
        told = LinkClient(state_to_wire_ms=None, work_ms=None)
        if client.tells:
            told = link_client_from_json(figures.read_text())
        return _link(client.name, json.loads(peer_log.read_text()), told)


def _link(name: str, counted: dict[str, object], told: LinkClient) -> Link:
    round_trip, sent, answered = (counted[key] for key in ("round_trip_ms", "sent", "answered"))
    if not isinstance(round_trip, dict) or not isinstance(sent, int):
        raise UserError(f"{name} has answered no attitude at all")
    return Link(
        client=name,
        output=str(counted["output"]).replace("_", " ").lower(),
        sent=sent,
        answered=answered if isinstance(answered, int) else 0,
        round_trip_ms=Percentiles(**round_trip),
        state_to_wire_ms=told.state_to_wire_ms,
        work_ms=told.work_ms,
    )


def _merge(links: list[Link]) -> Link:
    round_trip = median_percentiles(link.round_trip_ms for link in links)
    if round_trip is None:
        raise ValueError("no repeats to merge")
    return Link(
        client=links[0].client,
        output=links[0].output,
        sent=round(median(link.sent for link in links)),
        answered=round(median(link.answered for link in links)),
        round_trip_ms=round_trip,
        state_to_wire_ms=median_percentiles(link.state_to_wire_ms for link in links),
        work_ms=median_percentiles(link.work_ms for link in links),
    )
