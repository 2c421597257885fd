"""Output shared by the commands: tables, progress bars and figures."""

from collections.abc import Iterable
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from mavbridge.core.errors import UserError
from mavbridge.core.files import as_json, require_writable, write_output
from mavbridge.core.provenance import without_secrets
from mavbridge.observe.output import SafeConsole
from policy.errors import require_packages

PIPED_WIDTH = 120
"""Columns of the tables if there is no terminal."""
PICTURES = (".png", ".svg", ".pdf")
MUTED, GREY, BLUE, RED = "#6b7885", "#a9b4bf", "#2b6cb0", "#d1495b"
FIGURE_DPI = 150
FIGURE_STYLE = "seaborn-v0_8-whitegrid"
"""One of matplotlib's own styles."""


def require_outputs(json_file: Path | None, plot: Path | None) -> None:
    """Check the flags ``--json`` and ``--plot`` before a long run; raise UserError."""
    if plot is not None and plot.suffix.lower() not in PICTURES:
        raise UserError(f"--plot {plot}: name a file that ends in {', '.join(PICTURES)}")
    require_writable(json_file, "--json")
    require_writable(plot, "--plot")
    if plot is not None:
        require_packages("--plot", "matplotlib")


def write_json(path: Path | None, document: object) -> None:
    """Write the file that ``--json`` names, if it names one."""
    if path is not None:
        write_output(path, as_json(document), "--json")


def text_console(*, stderr: bool = False) -> Console:
    """Return a console that prints text as it is: a path may look like Rich's markup."""
    return SafeConsole(stderr=stderr, highlight=False, emoji=False, markup=False)


def print_warnings(console: Console, texts: Iterable[str]) -> None:
    """Print a line for each text, such as a sentence about a damaged flight."""
    for text in texts:
        console.print(f"warning: {text}", soft_wrap=True)


def table_console() -> Console:
    """Return a ``text_console`` as wide as the terminal or ``PIPED_WIDTH``."""
    console = text_console()
    if not console.is_terminal:
        console.width = PIPED_WIDTH
    return console


def make_table(
    title: str, header: Iterable[str], rows: Iterable[Iterable[str]], *, left_columns: int = 1
) -> Table:
    """Return a table whose first columns are text and whose others are right-aligned figures."""
    table = Table(title=title, title_justify="left")
    for index, name in enumerate(header):
        table.add_column(name, justify="left" if index < left_columns else "right")
    for row in rows:
        table.add_row(*row)
    return table


def print_status(line: str) -> None:
    """Print the current activity to standard error, apart from the results."""
    text_console(stderr=True).print(without_secrets(line), style="dim", soft_wrap=True)


def progress_bar(console: Console, *, as_percentage: bool = False) -> Progress:
    """Return a bar with description, count (or percentage), the text of each task's field
    ``status``, and time left."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn() if as_percentage else MofNCompleteColumn(),
        TextColumn("{task.fields[status]}", markup=False),
        TimeRemainingColumn(),
        console=console,
    )
