"""Rows of the check, their overall verdict, their JSON and their table."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mavbridge.commands.output import PIPED_WIDTH
from mavbridge.core.provenance import without_secrets

NO_VEHICLE = "none"
"""Value of ``--connect`` of a check without a vehicle."""
Area: TypeAlias = Literal["link", "vehicle", "parameters", "camera", "policy", "computer"]
Verdict: TypeAlias = Literal["go", "warn", "no-go"]
_STYLES: dict[Verdict, str] = {"go": "green", "warn": "yellow", "no-go": "bold red"}
_FOOT = "Nothing was set, armed or flown."
_REQUESTED = (
    " Message rates were requested as for a flight; they stay until the vehicle reboots or another "
    "station changes them."
)


@dataclass(frozen=True, slots=True)
class CheckRow:
    """One checked item: a go, unless there is a reason for a warning or a no-go."""

    area: Area
    name: str
    found: str
    expected: str = ""
    warn: str = ""
    """Reason for a warning, and the next step."""
    no_go: str = ""
    """Reason for a no-go, and the next step."""
    commands: tuple[str, ...] = ()
    """Flags that fix the problem for one flight."""

    def __post_init__(self) -> None:
        """Hide passwords in addresses, for the table and the JSON."""
        for name in ("found", "expected", "warn", "no_go"):
            object.__setattr__(self, name, without_secrets(getattr(self, name)))

    @property
    def verdict(self) -> Verdict:
        """The worse of the two, or a go."""
        return "no-go" if self.no_go else "warn" if self.warn else "go"

    @property
    def advice(self) -> str:
        """Reason for the verdict; empty for a go."""
        return self.no_go or self.warn


def overall(rows: Sequence[CheckRow]) -> Verdict:
    """Return the worst verdict of all rows."""
    verdicts = {row.verdict for row in rows}
    return "no-go" if "no-go" in verdicts else "warn" if "warn" in verdicts else "go"


def as_document(rows: Sequence[CheckRow]) -> dict[str, object]:
    """Return all rows in the order of the table, for JSON."""
    names = ("area", "name", "verdict", "found", "expected", "advice")
    return {
        "verdict": overall(rows),
        "rows": [
            {name: getattr(row, name) for name in names} | {"commands": list(row.commands)}
            for row in rows
        ],
    }


def print_check(rows: Sequence[CheckRow], console: Console) -> None:
    """Print all rows, then reasons and fixes of those that are not go, then the verdict."""
    if not console.is_terminal:
        console.width = PIPED_WIDTH
    console.print(_table(rows))
    for verdict in ("no-go", "warn"):
        _print_reasons([row for row in rows if row.verdict == verdict], console)
    console.print()
    has_vehicle = any(row.area == "vehicle" for row in rows)
    console.print(Text(_FOOT + _REQUESTED * has_vehicle, style="dim"))
    console.print(_summary(rows))


def _table(rows: Sequence[CheckRow]) -> Table:
    table = Table(pad_edge=False, box=None, padding=(0, 1), header_style="bold")
    table.add_column("", no_wrap=True)
    table.add_column("what", overflow="fold")
    table.add_column("found", overflow="fold", ratio=3)
    table.add_column("should be", overflow="fold", ratio=2, style="dim")
    area = None
    for row in rows:
        if row.area != area:
            area = row.area
            table.add_row("", Text(area, style="bold underline"))
        mark = Text(row.verdict, style=_STYLES[row.verdict])
        table.add_row(mark, Text(row.name), Text(row.found), Text(row.expected))
    return table


def _print_reasons(rows: Sequence[CheckRow], console: Console) -> None:
    """Print each reason with its row's name; reasons about parameters name those themselves."""
    if not rows:
        return
    grid = Table.grid(padding=(0, 1))
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    mark = Text(rows[0].verdict, style=_STYLES[rows[0].verdict])
    for row in rows:
        head = "" if row.area == "parameters" else f"{row.name}: "
        grid.add_row(mark, Text.assemble((head, "bold"), row.advice))
    console.print()
    console.print(grid)


def _summary(rows: Sequence[CheckRow]) -> Text:
    verdict = overall(rows)
    counts = {each: sum(row.verdict == each for row in rows) for each in _STYLES}
    told = f"{counts['go']} go, {counts['warn']} to be warned of, {counts['no-go']} no-go"
    word = "NO-GO" if verdict == "no-go" else "GO"
    flags = dict.fromkeys(command for row in rows for command in row.commands)
    cure = f"\nfor one flight, add: {' '.join(flags)}" if flags else ""
    return Text.assemble((word, _STYLES[verdict]), f": {told}{cure}")
