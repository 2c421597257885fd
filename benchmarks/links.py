"""The link alone, vehicle to vehicle: mavbridge and its peers, turn by turn in one run.

python -m benchmarks.links --rounds 3
python -m benchmarks.links --before ../earlier    beside an earlier checkout with a .venv of its own
"""

import sys
from pathlib import Path

from cyclopts import App
from rich.text import Text

from benchmarks.compare import peer_clients
from mavbridge.commands.bench.link import LINK_PROCESS, OUR_CLIENT, LinkClient, time_link
from mavbridge.commands.bench.results import OURS, link_table
from mavbridge.commands.output import table_console
from mavbridge.core.errors import UserError

app = App(help=__doc__)


@app.default
def main(*, attitudes: int = 1500, rounds: int = 1, before: Path | None = None) -> None:
    """Time every client ``rounds`` times.

    Parameters
    ----------
    attitudes
        Number of attitudes, of which 97 come a second.
    rounds
        Turns of each client: a slow minute of the host is shared by all.
    before
        An earlier checkout of mavbridge, from before the gate, with its .venv.
    """
    peers, notes = peer_clients()
    clients = [OUR_CLIENT, *peers]
    if before is not None:
        clients.insert(1, earlier_client(before.resolve()))
    results = [time_link(client, attitudes) for _ in range(rounds) for client in clients]
    console = table_console()
    console.print(link_table(results))
    for note in notes:
        console.print(Text(note, style="yellow"))


def earlier_client(checkout: Path) -> LinkClient:
    """mavbridge of another checkout, whose action loop was woken by attitudes on request."""
    python = checkout / ".venv" / "bin" / "python"
    if not python.exists():
        raise UserError(f"--before {checkout}: there is no {python}; install it there first")
    command = ("env", f"PYTHONPATH={checkout}", str(python), "-m", LINK_PROCESS, "--pace", "state")
    return LinkClient(name=f"{OURS} before", command=(*command, "--out", "/dev/null"))


if __name__ == "__main__":
    sys.exit(app())
