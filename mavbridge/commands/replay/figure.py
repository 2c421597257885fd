"""Pictures of replays: each stick, as it was recorded and as it came out now."""

from matplotlib import rc_context
from matplotlib.figure import Figure

from mavbridge.commands.output import BLUE, FIGURE_DPI, FIGURE_STYLE, GREY, MUTED
from mavbridge.commands.replay.actions import ActionResult
from mavbridge.commands.replay.results import ReplayResult
from mavbridge.core.vehicle import ACTION_CLASSES, Sticks


def make_figure(result: ReplayResult) -> Figure:
    """One row a stick, over the time since the first tick."""
    names = ACTION_CLASSES[result.source.contract.action]._fields
    sticks = result.sticks
    with rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(12.0, 8.0), dpi=FIGURE_DPI, facecolor="white")
        rows = figure.subplots(4, 1, sharex=True)
        for number, (axes, name) in enumerate(zip(rows, names, strict=True)):
            axes.plot(
                sticks.times_s, sticks.recorded[:, number], color=GREY, lw=3.0, label="recorded"
            )
            axes.plot(
                sticks.times_s, sticks.replayed[:, number], color=BLUE, lw=1.2, label="replayed"
            )
            largest = sticks.deviation.largest[number]
            axes.set_title(f"{name}, largest difference {largest:.2g}", fontsize=10)
        rows[0].legend(loc="upper right", ncols=2)
        rows[-1].set_xlabel("s since the first tick")
        figure.suptitle(
            f"{result.source.folder.name}: smoothed actions, replayed from {result.chosen}",
            x=0.012,
            ha="left",
            color=MUTED,
            fontsize=10,
        )
        figure.tight_layout(rect=(0, 0, 1, 0.98))
    return figure


def make_actions_figure(result: ActionResult) -> Figure:
    """One row a stick, over the time since the recording began."""
    actions = result.actions
    with rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(12.0, 8.0), dpi=FIGURE_DPI, facecolor="white")
        rows = figure.subplots(4, 1, sharex=True)
        for number, (axes, name) in enumerate(zip(rows, Sticks._fields, strict=True)):
            for values, label, color, width in (
                (actions.recorded, result.recorded_by, GREY, 3.0),
                (actions.policy, result.policy, BLUE, 1.2),
            ):
                axes.plot(actions.times_s, values[:, number], color=color, lw=width, label=label)
            axes.set_title(name, fontsize=10)
        rows[0].legend(loc="upper right", ncols=2)
        rows[-1].set_xlabel("s since the recording began")
        figure.suptitle(result.name, x=0.012, ha="left", color=MUTED, fontsize=10)
        figure.tight_layout(rect=(0, 0, 1, 0.98))
    return figure
