"""Write the state table of docs/safety.md from the guard's table: ``python -m
benchmarks.safety_table``."""

import inspect
from collections.abc import Callable, Iterator
from pathlib import Path

from mavbridge.guard.table import PROGRESS, TABLE
from mavbridge.guard.values import Phase

PAGE = Path(__file__).parents[1] / "docs" / "safety.md"
_CONTROLLED_BY = {
    Phase.WAITING: "the pilot; nothing is sent",
    Phase.PREPARING: "the pilot, or idle or neutral sticks: [the way in](#the-way-in)",
    Phase.FLYING: "the policy",
    Phase.LEAVING: "neutral sticks or setpoints, until a safe mode is confirmed",
    Phase.HOLDING: "neutral sticks: a release would be unsafe",
    Phase.RELEASING: "nobody: a release is sent every 50 ms, also after the link was reopened",
    Phase.RELEASED: "the pilot; nothing is sent. Continues as in WAITING",
    Phase.ENDED: "the pilot; a disarmed vehicle gets back the parameters of `--set` (4 s at most), "
    "and the process exits",
}


def table() -> str:
    """Return all states with their controllers and rows in reading order, then the explained words.

    A row is repeated in each of its states.
    """
    lines = ["| State | Event | Action | Next |", "|---|---|---|---|"]
    for phase in Phase:
        lines += _lines(phase)
    words = {
        _words(each) for row in (*TABLE, *PROGRESS) for each in (row.event, row.where, row.does)
    }
    lines += ["", "| Term | Meaning |", "|---|---|"]
    lines += sorted(f"| {name} | {meaning} |" for name, meaning in words if meaning)
    return "\n".join(lines) + "\n"


def _lines(phase: Phase) -> Iterator[str]:
    yield f"| **{phase.name}** | | {_CONTROLLED_BY[phase]} | |"
    if phase is Phase.RELEASED:
        return
    condition: object = None
    for row in (row for row in (*TABLE, *PROGRESS) if phase in row.states):
        event = _words(row.event)[0]
        if row.where is not None:
            event += f", and {_words(row.where)[0]}"
        elif row.event is condition:
            event += ", otherwise"
        condition = row.event if row.where is not None else None
        yield f"| | {event} | {_words(row.does)[0]} | {row.next.name if row.next else 'same'} |"


def _words(function: Callable[..., object] | None) -> tuple[str, str]:
    """Return the first line of a docstring, and the rest of it as one line."""
    name, _, meaning = (inspect.getdoc(function) or "").partition("\n") if function else ("",) * 3
    return name, " ".join(meaning.split())


def with_table(page: str) -> str:
    """Return the page with the current table."""
    return with_generated(page, "benchmarks.safety_table", table())


def with_generated(page: str, module: str, text: str) -> str:
    """Return the page with the text between the marks of its generating module."""
    begin, end = f"<!-- made by python -m {module} -->\n", "<!-- end -->\n"
    before, _, rest = page.partition(begin)
    _, _, after = rest.partition(end)
    return before + begin + text + end + after


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
