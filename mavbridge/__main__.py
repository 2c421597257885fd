"""Entry point: expected errors are one message and status 1; anything else is our bug."""

import signal
import sys
from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape

from mavbridge.cli import cli
from mavbridge.core.errors import MavbridgeError


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; by default that of the process."""
    try:
        sys.exit(cli.meta(arguments))
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    except MavbridgeError as error:
        console = Console(stderr=True, highlight=False, emoji=False)
        console.print(f"[bold red]error:[/] {escape(str(error))}", soft_wrap=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
