"""An evaluation for a terminal."""

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mavbridge.commands.evaluate.results import Evaluation, summarise
from mavbridge.commands.evaluate.statistics import Estimate


def print_evaluation(evaluation: Evaluation, console: Console) -> None:
    """The figures, then how the flights ended."""
    summary = summarise(evaluation.episodes)
    console.print(summary_table(evaluation))
    ends = ", ".join(f"{count} {outcome}" for outcome, count in summary.outcomes)
    console.print(Text(f"{len(evaluation.episodes)} flights: {ends}"))


def summary_table(evaluation: Evaluation) -> Table:
    """A row for each figure, with its 95 % interval."""
    summary = summarise(evaluation.episodes)
    gates = evaluation.episodes[0].gates_total
    table = Table(title=f"{evaluation.policy} ({evaluation.engine}), {evaluation.setting}")
    for heading in ("", "mean", "95 % interval", "flights"):
        table.add_column(heading, justify="left" if heading == "" else "right")
    table.add_row("success rate", *_cells(summary.success_rate, "{:.1%}"))
    for name, estimate in (
        (f"gates passed, of {gates}", summary.gates_passed),
        ("mean speed, m/s", summary.mean_speed_mps),
        ("stick movement, 1/s", summary.stick_rate_per_s),
        ("flown, s", summary.flown_s),
        ("course time, s (successful flights)", summary.course_s),
    ):
        table.add_row(name, *_cells(estimate, "{:.2f}"))
    return table


def _cells(estimate: Estimate | None, form: str) -> tuple[str, str, str]:
    if estimate is None:
        return "-", "-", "0"
    interval = "-"
    if estimate.low is not None and estimate.high is not None:
        interval = f"{form.format(estimate.low)} to {form.format(estimate.high)}"
    return form.format(estimate.value), interval, str(estimate.count)
