"""Entry point: expected errors are one message and their status; anything else is our bug."""

import errno
import importlib.util
import io
import os
import signal
import sys
from collections.abc import Sequence
from functools import partial
from importlib.machinery import ModuleSpec
from pathlib import Path

import mavbridge
from mavbridge import OUR_SAFE_PATH, SAFE_PATH

PACKAGES = ("policy", "sitl")
"""Packages beside ``mavbridge`` whose names a user's module may have."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; by default that of the process."""
    if arguments is None:  # our process: its children import nothing from the working directory
        os.environ.setdefault(SAFE_PATH, OUR_SAFE_PATH)
        open_closed_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):  # escape what its encoding lacks, as stderr does
        sys.stdout.reconfigure(errors="backslashreplace")
    if (problem := hidden_package()) is not None:
        sys.stderr.write(f"error: {problem}\n")
        sys.exit(2)  # ExitCode.REFUSED, which cannot be imported yet
    # Only now: these import the packages that may be hidden.
    from mavbridge.core.errors import MavbridgeError, UserError
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
    except (MavbridgeError, OSError) as raised:
        error = raised if isinstance(raised, MavbridgeError) else UserError(_forbidden(raised))
        message = f"[bold red]error:[/] {escape(without_secrets(str(error)))}"
        console = SafeConsole(stderr=True, highlight=False, emoji=False)
        end(error.exit_code, partial(console.print, message, soft_wrap=True))
    end(status or 0)


def _forbidden(error: OSError) -> str:
    """Return a message about a path that this user may not use; raise any other error again.

    Any look at a path may fail so, if only ``Path.exists``.
    """
    if error.errno not in (errno.EACCES, errno.ENAMETOOLONG) or error.filename is None:
        raise error
    return (
        f"{error.filename}: {error.strerror}; name another path, or let this user "
        f"(id {os.geteuid()}) reach it"
    )


def open_closed_streams() -> None:
    """Open closed standard streams on the null device: a link or a log would get their numbers."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", closefd=False))


def hidden_package() -> str | None:
    """Return an error message if a user's module hides one of ``PACKAGES``, else None.

    Imports nothing. Python searches the working directory first (``python -m``), then PYTHONPATH.
    """
    for name in PACKAGES:
        if (spec := _found(name)) is None:
            return f"mavbridge's own package {name} is missing: install mavbridge again"
        places = [spec.origin, *(spec.submodule_search_locations or ())]
        found = next(place for place in places if place is not None)
        if Path(found).resolve() != (Path(__file__).parents[1] / name / "__init__.py").resolve():
            return (
                f"{found} hides mavbridge's own package {name}: run `mavbridge`, not `python -m "
                "mavbridge`, and take that folder off PYTHONPATH; or rename it. As a policy it "
                f"flies by its path: --policy ./{name}.py:Class"
            )
    return None


def _found(name: str) -> ModuleSpec | None:
    """Return what ``import`` would find with the working directory on the search path."""
    path, sys.path = sys.path, [*mavbridge.left_out, *sys.path]
    try:
        return importlib.util.find_spec(name)
    finally:
        sys.path = path


if __name__ == "__main__":
    main()
