"""What a policy decided beside a recording of somebody else, for a person and for a program."""

import json
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.text import Text

from mavbridge.commands.output import make_table
from mavbridge.core.vehicle import Sticks
from mavbridge.simulation.replay.actions import ActionComparison


@dataclass(frozen=True, kw_only=True)
class ActionResult:
    """One policy beside one recording."""

    name: str
    """Name of the recording."""
    recorded_by: str
    """Whose actions they are compared with."""
    policy: str
    engine: str
    actions: ActionComparison
    notes: tuple[str, ...]
    """What the recording lacks, and what the policy refused."""

    @property
    def figures(self) -> dict[str, list[float]]:
        """Figures of each stick, in full deflections; empty where nobody had sticks."""
        difference = self.actions.difference
        if not len(difference):
            return {}
        size = np.abs(difference)
        return {
            "mean": size.mean(axis=0).tolist(),
            "mean, signed": difference.mean(axis=0).tolist(),
            "largest": size.max(axis=0).tolist(),
        }


def print_actions(result: ActionResult, console: Console) -> None:
    """The table, and what it is about."""
    actions = result.actions
    rows = [
        [name, *(f"{value:.3f}" for value in values)] for name, values in result.figures.items()
    ]
    title = f"{result.name}: first action of each solve, against {result.recorded_by}"
    console.print(make_table(title, ["difference", *Sticks._fields], rows))
    console.print(
        Text(
            f"{len(actions.times_s)} solves of {result.policy} on {result.engine}, "
            f"{len(actions.difference)} of them with something to compare with"
        )
    )
    for note in result.notes:
        console.print(Text(f"note: {note}", style="yellow"))


def to_json(result: ActionResult) -> str:
    """All figures."""
    actions = result.actions
    document = {
        "recording": result.name,
        "policy": result.policy,
        "engine": result.engine,
        "solves": len(actions.times_s),
        "compared": len(actions.difference),
        "sticks": Sticks._fields,
        "difference": result.figures,
        "notes": result.notes,
    }
    return json.dumps(document, indent=2) + "\n"
