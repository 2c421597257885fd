"""Entry point: expected errors are one message and their status; anything else is our bug."""

import signal
from collections.abc import Sequence
from functools import partial

from rich.console import Console
from rich.markup import escape

from mavbridge.cli import cli
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.stopping import end_process


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; by default that of the process."""
    try:
        status = cli.meta(arguments)
    except KeyboardInterrupt:
        end_process(128 + signal.SIGINT)
    except MavbridgeError as error:
        message = f"[bold red]error:[/] {escape(str(error))}"
        console = Console(stderr=True, highlight=False, emoji=False)
        end_process(error.exit_code, partial(console.print, message, soft_wrap=True))
    end_process(status or 0)


if __name__ == "__main__":
    main()
