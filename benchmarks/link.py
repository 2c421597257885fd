"""Measure the latency of the link: mavbridge and other clients in turn, against one timing vehicle.

python -m benchmarks.link --rounds 3
"""

import pickle
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from cyclopts import App
from rich.text import Text

from benchmarks.link_vehicle import ATTITUDE_HZ, CONNECT_S
from benchmarks.results import OURS, LinkLatency, link_table
from mavbridge.commands.output import print_status, table_console
from mavbridge.core.errors import UserError
from mavbridge.core.processes import IMPORT_ROOT, end, free_port, log_tail, running, wait

LINK_VEHICLE = "benchmarks.link_vehicle"
PEERS_PYTHON = IMPORT_ROOT / ".venv-peers" / "bin" / "python"
STARTING_S = 15.0
"""Time for imports [s], in addition to the vehicle's time for a client to connect."""
app = App(help=__doc__)


@dataclass(frozen=True, kw_only=True)
class LinkClient:
    """Program that answers each attitude with sticks."""

    name: str
    module: str
    python: str = sys.executable


OUR_CLIENT = LinkClient(name=OURS, module="benchmarks.link_client")
BARE_CLIENT = LinkClient(name="bare pymavlink loop", module="benchmarks.link_pymavlink")
MAVSDK_CLIENT = LinkClient(
    name="MAVSDK-Python 4", module="benchmarks.link_mavsdk", python=str(PEERS_PYTHON)
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


def time_link(client: LinkClient, attitudes: int) -> LinkLatency:
    """Time one client.

    Raises:
        UserError: the client or the vehicle failed; quotes the end of both logs.
    """
    print_status(f"link: {client.name}")
    port = str(free_port())
    timeout_s = STARTING_S + CONNECT_S + 1.1 * attitudes / ATTITUDE_HZ
    with TemporaryDirectory(prefix="mavbridge-bench-") as name:
        folder = Path(name)
        log, vehicle_log, answers = (folder / file for file in ("client", "vehicle", "answers"))
        client_command = (client.python, "-m", client.module, "--port", port)
        vehicle_command = (
            *(sys.executable, "-m", LINK_VEHICLE, "--port", port),
            *("--attitudes", str(attitudes), "--out", str(answers)),
        )
        with (
            running(*client_command, log=log) as process,
            running(*vehicle_command, log=vehicle_log) as vehicle,
        ):
            try:
                wait(vehicle, f"python -m {LINK_VEHICLE}", vehicle_log, timeout_s)
            except UserError as error:
                raise UserError(f"{client.name}: {error}\nits log: {log_tail(log)}") from error
            end(process)
        counted: LinkLatency = pickle.loads(answers.read_bytes())  # noqa: S301 - our child's
        if counted.round_trip_ms is None:
            raise UserError(f"{client.name} answered no attitude; its log: {log_tail(log)}")
        return replace(counted, client=client.name)


if __name__ == "__main__":
    sys.exit(app())
