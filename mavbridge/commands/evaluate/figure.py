"""The picture of an evaluation: gates passed, outcomes, speed against smoothness."""

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mavbridge.commands.evaluate.results import Evaluation, rate
from mavbridge.commands.output import BLUE, FIGURE_DPI, FIGURE_STYLE, MUTED, RED


def make_figure(evaluation: Evaluation) -> Figure:
    """Share of flights by gate, outcomes, and speed against smoothness, of one or more episodes."""
    with rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(12.0, 4.2), dpi=FIGURE_DPI, facecolor="white")
        axes = figure.subplots(1, 3)
        _draw_gates(axes[0], evaluation)
        _draw_outcomes(axes[1], evaluation)
        _draw_smoothness(axes[2], evaluation)
        figure.suptitle(
            f"{evaluation.title}, {len(evaluation.episodes)} held-out courses",
            x=0.012,
            ha="left",
            color=MUTED,
            fontsize=10,
        )
        figure.tight_layout(rect=(0, 0, 1, 0.97), w_pad=3)
    return figure


def _draw_gates(axes: Axes, evaluation: Evaluation) -> None:
    episodes = evaluation.episodes
    gates = range(1, episodes[0].gates_total + 1)
    shares = [
        rate(sum(one.gates_passed >= gate for one in episodes), len(episodes)) for gate in gates
    ]
    axes.fill_between(
        gates,
        [share.low or 0.0 for share in shares],
        [share.high or 0.0 for share in shares],
        color=BLUE,
        alpha=0.15,
        linewidth=0,
    )
    axes.plot(gates, [share.value for share in shares], "o-", color=BLUE)
    axes.set_ylim(-0.03, 1.03)
    axes.set_xlabel("gate")
    axes.set_title("Flights that passed gate n, 95 %")


def _draw_outcomes(axes: Axes, evaluation: Evaluation) -> None:
    outcomes = evaluation.summary.outcomes
    names, counts = [name for name, _ in outcomes], [count for _, count in outcomes]
    colours = [BLUE if name == "finished" else RED for name in names]
    axes.bar_label(axes.barh(names, counts, 0.6, color=colours), padding=4)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.margins(x=0.12)
    axes.set_xlabel("flights")
    axes.set_title("How they ended")


def _draw_smoothness(axes: Axes, evaluation: Evaluation) -> None:
    for has_finished, colour, label in ((True, BLUE, "finished"), (False, RED, "not finished")):
        dots = [
            (one.mean_speed_mps, one.stick_rate_per_s)
            for one in evaluation.episodes
            if one.has_finished == has_finished and one.stick_rate_per_s is not None
        ]
        if dots:
            axes.plot(*zip(*dots, strict=True), "o", color=colour, alpha=0.6, label=label)
    if axes.lines:  # margins are shares of the range, which is none where all flights are alike
        axes.set_xlim(0, 1.15 * axes.dataLim.x1 or 1)
        axes.set_ylim(0, 1.15 * axes.dataLim.y1 or 1)
    axes.set_xlabel("mean speed, m/s")
    axes.set_ylabel("stick movement, 1/s")
    axes.set_title("Speed and smoothness")
    if axes.lines:
        axes.legend(loc="best")
