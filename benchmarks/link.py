"""Measure the latency of the link: mavbridge and other clients in turn, against one timing vehicle.

python -m benchmarks.link --rounds 3
"""

import json
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from cyclopts import App
from rich.table import Table
from rich.text import Text

from benchmarks.link_vehicle import ATTITUDE_HZ, CONNECT_S, LinkLatency
from mavbridge.commands.output import make_table, print_status, table_console
from mavbridge.core.errors import UserError
from mavbridge.core.processes import IMPORT_ROOT, child_environment, free_port, log_tail, running
from mavbridge.core.vehicle import Percentiles
from mavbridge.observe.terminal import number

PEERS_PYTHON = IMPORT_ROOT / ".venv-peers" / "bin" / "python"
STARTING_S = 15.0
"""Time for imports [s], in addition to the vehicle's time for a client to connect."""
app = App(help=__doc__)


class LinkClient(NamedTuple):
    """Program that answers each attitude with sticks."""

    name: str
    command: tuple[str, ...]
    """With {port} for its UDP port."""


# No smoothing and no mapping, so that the vehicle finds its code unchanged. Its attitude never
# changes. Chunks at twice its rate, so that an attitude closely after a late one is answered at
# once.
OUR_CLIENT = LinkClient(
    "mavbridge",
    (
        *(sys.executable, "-m", "mavbridge", "--connect", "udp:127.0.0.1:{port}"),
        *("--policy", f"{Path(__file__).parent / 'link_policy.py'}:RollRate", "--dual-rate"),
        *("--camera", "none", "--arm", "--on-fault", "release", "--then", "release"),
        *("--set-config", "limits.tau=0", "--set-config", "limits.slew=0"),
        *("--set-config", "limits.frozen_state=0", "--set-config", "rates.action=200"),
        *("--set-config", "link.raw_sticks=true"),
    ),
)
BARE_CLIENT = LinkClient(
    "bare pymavlink loop",
    (sys.executable, "-m", "benchmarks.link_pymavlink", "--port", "{port}"),
)
MAVSDK_CLIENT = LinkClient(
    "MAVSDK-Python 4",
    (str(PEERS_PYTHON), "-m", "benchmarks.link_mavsdk", "--port", "{port}"),
)


@app.default
def main(*, attitudes: int = 1500, rounds: int = 1) -> None:
    """Time every client ``rounds`` times.

    Args:
        attitudes: number of attitudes, sent at 97 per second.
        rounds: turns of each client, so that a slow minute of the host affects all.
    """
    clients, notes = link_clients()
    results = [time_link(client, attitudes) for _ in range(rounds) for client in clients]
    console = table_console()
    console.print(link_table(results))
    for note in notes:
        console.print(Text(note, style="yellow"))


def link_clients() -> tuple[tuple[LinkClient, ...], tuple[str, ...]]:
    """Return our client and its peers, and the reason why one of them cannot run here."""
    if PEERS_PYTHON.is_file():
        return (OUR_CLIENT, BARE_CLIENT, MAVSDK_CLIENT), ()
    note = f"{MAVSDK_CLIENT.name}: not measured, there is no {PEERS_PYTHON} (make bench)"
    return (OUR_CLIENT, BARE_CLIENT), (note,)


def link_table(links: Iterable[LinkLatency]) -> Table:
    """Return a table with a row for each client."""
    rows = []
    for link in links:
        trip = link.round_trip_ms
        values = () if trip is None else (trip.p50, trip.p99, trip.max)
        spread = " / ".join(number(value, 2) for value in values)
        rows.append((link.client, f"{link.answered} of {link.sent}", spread))
    title = "Link alone: attitude out of the vehicle to sticks back in, ms (p50 / p99 / max)"
    return make_table(title, ("client", "answered", "round trip"), rows)


def time_link(client: LinkClient, attitudes: int) -> LinkLatency:
    """Time one client.

    Raises:
        UserError: the client or the vehicle failed; quotes the end of the client's log.
    """
    print_status(f"link: {client.name}")
    port = str(free_port())
    timeout_s = STARTING_S + CONNECT_S + 1.1 * attitudes / ATTITUDE_HZ
    vehicle = (sys.executable, "-m", "benchmarks.link_vehicle", "--port", port)
    with TemporaryDirectory(prefix="mavbridge-bench-") as folder:
        log = Path(folder) / "client"
        with running(*(word.format(port=port) for word in client.command), log=log):
            try:
                timed = subprocess.run(
                    (*vehicle, "--attitudes", str(attitudes)),
                    check=True,
                    stdout=subprocess.PIPE,
                    env=child_environment(),
                    timeout=timeout_s,
                )
            except subprocess.SubprocessError as error:
                raise UserError(f"{client.name}: {error}\nits log: {log_tail(log)}") from error
    figures = json.loads(timed.stdout)
    trip = figures["round_trip_ms"] and Percentiles(**figures["round_trip_ms"])
    return LinkLatency(**figures | {"client": client.name, "round_trip_ms": trip})


if __name__ == "__main__":
    sys.exit(app())
