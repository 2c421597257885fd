"""The link alone, vehicle to vehicle: mavbridge and its peers, turn by turn in one run.

python -m benchmarks.links --rounds 3
"""

import sys

from cyclopts import App
from rich.text import Text

from benchmarks.compare import peer_clients
from benchmarks.link import OUR_CLIENT, time_link
from benchmarks.results import link_table
from mavbridge.commands.output import table_console

app = App(help=__doc__)


@app.default
def main(*, attitudes: int = 1500, rounds: int = 1) -> None:
    """Time every client ``rounds`` times.

    Parameters
    ----------
    attitudes
        Number of attitudes, of which 97 come a second.
    rounds
        Turns of each client: a slow minute of the host is shared by all.
    """
    peers, notes = peer_clients()
    clients = (OUR_CLIENT, *peers)
    results = [time_link(client, attitudes) for _ in range(rounds) for client in clients]
    console = table_console()
    console.print(link_table(results))
    for note in notes:
        console.print(Text(note, style="yellow"))


if __name__ == "__main__":
    sys.exit(app())
