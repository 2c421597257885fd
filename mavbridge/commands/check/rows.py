"""Rows of the check, and the verdict on all of them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, TypedDict

from mavbridge.core.provenance import without_secrets

Area: TypeAlias = Literal["link", "vehicle", "parameters", "camera", "policy", "computer"]
Verdict: TypeAlias = Literal["go", "warn", "no-go"]
_FLAG = re.compile(r"--set [A-Z0-9_]+=-?\d+(?:\.\d+)?|--source-system \d+|ulimit -\w \w+")


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One thing that was looked at."""

    area: Area
    name: str
    found: str
    expected: str = ""
    verdict: Verdict = "go"
    advice: str = ""
    """The reason for a warning or a no-go, and what to do; empty for a go."""

    def __post_init__(self) -> None:
        """Hide the passwords of addresses, for the table and the JSON."""
        for name in ("found", "expected", "advice"):
            object.__setattr__(self, name, without_secrets(getattr(self, name)))

    @property
    def commands(self) -> tuple[str, ...]:
        """Flags and commands in the advice that mend it."""
        return tuple(_FLAG.findall(self.advice))


class RowDocument(TypedDict):
    """One row as JSON."""

    area: Area
    name: str
    verdict: Verdict
    found: str
    expected: str
    advice: str
    commands: list[str]


class CheckDocument(TypedDict):
    """The whole check as JSON."""

    verdict: Verdict
    rows: list[RowDocument]


def overall(rows: Sequence[Row]) -> Verdict:
    """The worst verdict of all."""
    verdicts = {row.verdict for row in rows}
    return "no-go" if "no-go" in verdicts else "warn" if "warn" in verdicts else "go"


def as_document(rows: Sequence[Row]) -> CheckDocument:
    """All rows in the order of the table."""
    return CheckDocument(
        verdict=overall(rows),
        rows=[
            RowDocument(
                area=row.area,
                name=row.name,
                verdict=row.verdict,
                found=row.found,
                expected=row.expected,
                advice=row.advice,
                commands=list(row.commands),
            )
            for row in rows
        ],
    )
