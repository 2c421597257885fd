"""Entry point: expected errors are one message and their status; anything else is our bug."""

import io
import os
import signal
import sys
from collections.abc import Sequence
from functools import partial

from mavbridge.core.own_packages import OUR_SAFE_PATH, SAFE_PATH, hidden_package


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; by default that of the process."""
    if arguments is None:  # our process: its children import nothing from the working directory
        os.environ.setdefault(SAFE_PATH, OUR_SAFE_PATH)
    if isinstance(sys.stdout, io.TextIOWrapper):  # escape what its encoding lacks, as stderr does
        sys.stdout.reconfigure(errors="backslashreplace")
    if (problem := hidden_package()) is not None:
        sys.stderr.write(f"error: {problem}\n")
        sys.exit(2)  # ExitCode.REFUSED, which cannot be imported yet
    # Only now: these import the packages that may be hidden.
    from mavbridge.core.errors import MavbridgeError
    from mavbridge.core.provenance import without_secrets
    from mavbridge.core.stopping import end_process, interrupt_once

    end = partial(end_process, must_exit=arguments is None)
    if arguments is None:
        interrupt_once()
    try:
        from rich.markup import escape

        from mavbridge.cli import cli
        from mavbridge.config.settings_files import with_home
        from mavbridge.observe.output import SafeConsole, survive_lost_readers

        if arguments is None:
            survive_lost_readers()
        status = cli.meta(with_home(list(sys.argv[1:] if arguments is None else arguments)))
    except KeyboardInterrupt:
        end(128 + signal.SIGINT)
    except MavbridgeError as error:
        message = f"[bold red]error:[/] {escape(without_secrets(str(error)))}"
        console = SafeConsole(stderr=True, highlight=False, emoji=False)
        end(error.exit_code, partial(console.print, message, soft_wrap=True))
    end(status or 0)


if __name__ == "__main__":
    main()
