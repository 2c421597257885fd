"""Results of a replay, for people and for programs."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.text import Text

from mavbridge.commands.config import ReplayFrom
from mavbridge.commands.output import BLUE, FIGURE_DPI, FIGURE_STYLE, GREY, MUTED, make_table
from mavbridge.core.vehicle import ACTION_CLASSES
from mavbridge.simulation.replay.compare import (
    PAST_INPUTS,
    Deviation,
    GuardComparison,
    PolicyComparison,
    StickTraces,
)
from mavbridge.simulation.replay.recording import ReplaySource


@dataclass(frozen=True, kw_only=True)
class ReplayResult:
    """Results of one replay."""

    source: ReplaySource
    chosen: ReplayFrom
    engine: str | None
    """Engine of the policy; None: the policy was not used."""
    policy: PolicyComparison | None
    guard: GuardComparison
    """Comparison with the recorded chunks and settings."""
    sticks: StickTraces
    """Sticks from the new chunks and settings."""
    tolerance: float | None
    """None: the policy or the limits were changed, so that no agreement is expected."""

    @property
    def problems(self) -> tuple[str, ...]:
        """Reasons why the replay is not equal, in words."""
        found = []
        if self.guard.first is not None:
            found.append(f"the guard came out differently, first in the {self.guard.first}")
        if self.tolerance is None:
            return tuple(found)
        for name, count in self.policy.missing.items() if self.policy else ():
            found.append(f"{count} solves were not repeated: {name}")
        for name, count in self.policy.inputs_differ.items() if self.policy else ():
            if name not in PAST_INPUTS:
                found.append(f"{count} solves were given another input: {name}")
        if self.policy is not None and self.tolerance == 0:
            other = self.policy.solves - self.policy.equal_chunks
            if other:
                found.append(f"{other} of {self.policy.solves} chunks differ")
        if self.sticks.deviation.most > self.tolerance:
            found.append(
                f"a stick is off by {self.sticks.deviation.most:.4g}, more than {self.tolerance:g}"
            )
        return tuple(found)

    @property
    def is_equal(self) -> bool:
        """True if it is equal within the tolerance, or no agreement was expected."""
        return not self.problems


def print_replay(result: ReplayResult, console: Console) -> None:
    """Print tables, and a verdict in words."""
    names = ACTION_CLASSES[result.source.contract.action]._fields
    rows = []
    if (policy := result.policy) is not None:
        equal = f"{policy.equal_chunks} of {policy.solves} chunks"
        rows.append(_row("policy: chunks", equal, policy.deviation))
    guard = result.guard
    same = f"{guard.steps - max(guard.differ.values(), default=0)} of {guard.steps} ticks"
    rows.append(_row("guard: sticks, recorded chunks", same, guard.deviation))
    if result.policy is not None or result.tolerance is None:
        moved = result.sticks.deviation
        rows.append(_row("sticks, these chunks and limits", "", moved))
        rows.append(_row("the same, rms", "", Deviation(largest=moved.rms, rms=moved.rms)))
    title = f"replay of {result.source.folder} from {result.chosen}"
    header = ["largest difference", "equal", *names]
    console.print(make_table(title, header, rows, left_columns=2))
    recorded = f"recorded with {result.source.meta.policy} on {result.source.meta.engine}"
    console.print(Text(recorded + (f", replayed on {result.engine}" if result.engine else "")))
    for gap in result.source.gaps:
        console.print(Text(f"note: {gap}", style="yellow"))
    past = result.policy.inputs_differ if result.policy and result.tolerance is not None else {}
    for name in PAST_INPUTS:
        if name in past:
            note = f"{name} of {past[name]} solves are the recorded ones: built anew, they differ"
            console.print(Text(f"note: {note}", style="yellow"))
    for problem in result.problems:
        console.print(Text(f"different: {problem}", style="red"))
    console.print(Text(_verdict(result), style="bold"))


def _verdict(result: ReplayResult) -> str:
    if not result.is_equal:
        return "NOT EQUAL"
    if result.tolerance is None:
        return "the difference is what was asked for"
    if result.tolerance == 0:
        return "EQUAL, bit for bit"
    return f"EQUAL within {result.tolerance:g} of full stick"


def _row(name: str, equal: str, deviation: Deviation) -> list[str]:
    return [name, equal, *(_figure(value) for value in deviation.largest)]


def _figure(value: float) -> str:
    return "0" if value == 0 else f"{value:.2g}"


def to_json(result: ReplayResult) -> str:
    """Return all figures as JSON."""
    document = {
        "flight": str(result.source.folder),
        "from": result.chosen,
        "recorded_engine": result.source.meta.engine,
        "engine": result.engine,
        "tolerance": result.tolerance,
        "is_equal": result.is_equal,
        "problems": result.problems,
        "gaps": result.source.gaps,
        "policy": None if result.policy is None else asdict(result.policy),
        "guard": asdict(result.guard),
        "sticks": asdict(result.sticks.deviation),
    }
    return json.dumps(_finite(document), indent=2) + "\n"


def _finite(value: object) -> object:
    """Replace infinity, which JSON lacks, by null: only one of the two was flown."""
    if isinstance(value, dict):
        return {name: _finite(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and value in (float("inf"),) else value


def draw(result: ReplayResult, path: Path) -> None:
    """Draw the smoothed sticks, recorded and replayed, over time: one row per stick."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    names = ACTION_CLASSES[result.source.contract.action]._fields
    sticks = result.sticks
    with rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(12.0, 8.0), dpi=FIGURE_DPI, facecolor="white")
        rows = figure.subplots(4, 1, sharex=True)
        for number, (axes, name) in enumerate(zip(rows, names, strict=True)):
            for values, label, color, width in (
                (sticks.recorded, "recorded", GREY, 3.0),
                (sticks.replayed, "replayed", BLUE, 1.2),
            ):
                axes.plot(sticks.times_s, values[:, number], color=color, lw=width, label=label)
            largest = sticks.deviation.largest[number]
            axes.set_title(f"{name}, largest difference {largest:.2g}", fontsize=10)
        rows[0].legend(loc="upper right", ncols=2)
        rows[-1].set_xlabel("s since the first tick")
        title = f"{result.source.folder.name}: smoothed actions, replayed from {result.chosen}"
        figure.suptitle(title, x=0.012, ha="left", color=MUTED, fontsize=10)
        figure.tight_layout(rect=(0, 0, 1, 0.98))
        figure.savefig(path)
