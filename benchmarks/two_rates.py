"""Compare two rates with one: a fast loop beside the encoder, and a loop that waits for it.

python -m benchmarks.two_rates --episodes 50 --json map.json --plot map.png

For each encoding time of an image, the same courses are flown by a single loop, as fast as the
encoder and the action head allow, and at two rates: as many images per second as the encoder can
make, and 100 or 250 actions per second from the newest state. Each cell is a separate ``mavbridge
evaluate``. Cells that the JSON holds for the same weights and number of episodes are not flown
again, so an interrupted map resumes.

The stick weights fly the same courses in two ways that differ only in who closes attitude and
climb: by sticks the autopilot, by body rates the policy. They fly both ways in gusts, and by body
rates on PX4, which has a slower rate loop and an airframe with more drag.
"""

import hashlib
import math
import subprocess
import sys
from dataclasses import asdict, dataclass
from itertools import product
from json import dumps, loads
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

from cyclopts import App

from mavbridge.commands.output import (
    BLUE,
    FIGURE_DPI,
    FIGURE_STYLE,
    MUTED,
    RED,
    make_table,
    require_outputs,
    table_console,
)
from policy.loading.builtin import SHIPPED, SHIPPED_RATES

Loop = Literal["one rate", "100 actions a second", "250 actions a second"]
LOOPS: tuple[Loop, ...] = ("one rate", "100 actions a second", "250 actions a second")
ENCODER_MS = (5, 20, 50, 100, 200)
HEAD_MS = 4
"""Time of the action head beside the encoder in a single loop: 3 ms, and a margin for late ones."""
MOST_HZ = 100.0
"""Highest rate requested of a single loop: the rate of the vehicle's state."""
CAMERA_HZ = 30.0
PANELS_A_ROW = 3
LOOSE = " ".join(
    f"--set-config limits.{age}=2"
    for age in ("attitude_age", "velocity_age", "feature_age", "chunk_age")
)
"""Age limits so wide that nothing is refused: the cost of age is being measured."""
app = App(help=__doc__)


class Control(NamedTuple):
    """Controlled quantity, vehicle and courses of a group."""

    name: str
    flags: str
    is_race: bool = False
    """True: flown by the weights that learned from races."""


GUSTS = "--gusts 2"
"""RMS of the gusts along each horizontal axis [m/s], more than in any demonstration."""
CONTROLS = (
    Control("sticks in ALT_HOLD, easy courses", "--courses easy"),
    Control("the same weights by body rates", "--courses easy --by-rates"),
    Control("body rates, race courses", "--courses race --policy toge-rates", is_race=True),
    Control("sticks, gusts of 2 m/s", f"--courses easy {GUSTS}"),
    Control("by body rates, gusts of 2 m/s", f"--courses easy --by-rates {GUSTS}"),
    Control("by body rates, PX4 and its airframe", "--courses easy --by-rates --autopilot px4"),
)
"""Groups of the map. Body rates reach 63 % of a step after 53 ms on ArduPilot, 100 ms on PX4."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One evaluated cell; intervals are 95 %."""

    control: str
    loop: Loop
    encoder_ms: int
    command: str
    checkpoint_sha256: str
    episodes: int
    success: float
    success_low: float
    success_high: float
    gates: float
    speed_mps: float

    @property
    def key(self) -> tuple[str, str, int, int, str]:
        """Identity of the cell."""
        return self.control, self.loop, self.encoder_ms, self.episodes, self.checkpoint_sha256


@app.default
def main(
    *,
    json: Path,
    plot: Path | None = None,
    episodes: int = 50,
    workers: int = 2,
    sticks: Path = SHIPPED,
    rates: Path = SHIPPED_RATES,
) -> None:
    """Evaluate the missing cells, then print and draw all.

    Args:
        json: file of the cells.
        plot: PNG to draw them in.
        episodes: courses for each cell.
        workers: episodes at a time.
        sticks: weights by sticks.
        rates: weights that learned from races by body rates.
    """
    require_outputs(json, plot)
    known = [Cell(**one) for one in loads(json.read_text())] if json.exists() else []
    cells = {cell.key: cell for cell in known}
    shown = []
    for control, encoder_ms, loop in product(CONTROLS, ENCODER_MS, LOOPS):
        weights = rates if control.is_race else sticks
        key = (control.name, loop, encoder_ms, episodes, sha256(weights))
        if key not in cells:
            cells[key] = evaluate(control, loop, encoder_ms, weights, episodes, workers)
            json.write_text(dumps([asdict(one) for one in cells.values()], indent=2) + "\n")
            print_cells([cells[key]])
        shown.append(cells[key])
    print_cells(shown)
    if plot is not None:
        draw(shown, plot)


def flags_of(loop: Loop, encoder_ms: int) -> str:
    """Return the flags of ``mavbridge evaluate`` for a loop beside an encoder of this speed."""
    if loop == "one rate":
        rate_hz = min(MOST_HZ, 1000 / (encoder_ms + HEAD_MS))
        visual = f"--set-config rates.visual={max(CAMERA_HZ, rate_hz):.4g}"
        return f"--single-rate --set-config rates.single={rate_hz:.4g} {visual}"
    visual = f"--set-config rates.visual={min(CAMERA_HZ, 1000 / encoder_ms):.4g}"
    return f"--dual-rate {visual} --set-config rates.action={loop.partition(' ')[0]}"


def evaluate(
    control: Control, loop: Loop, encoder_ms: int, weights: Path, episodes: int, workers: int
) -> Cell:
    """Fly one cell.

    Raises:
        subprocess.CalledProcessError: the evaluation failed, and printed why.
    """
    flags = f"{control.flags} {flags_of(loop, encoder_ms)} --num-diffusion-steps 1"
    flags += f" --vision-time {encoder_ms} {LOOSE} --episodes {episodes} --max-time 45"
    with TemporaryDirectory() as folder:
        out = Path(folder) / "evaluation.json"
        files = ("--checkpoint", str(weights), "--workers", str(workers), "--json", str(out))
        command = [sys.executable, "-m", "mavbridge", "evaluate", *flags.split(), *files]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        summary = loads(out.read_text())["summary"]
    success, speed = summary["success_rate"], summary["course_speed_mps"]
    return Cell(
        control=control.name,
        loop=loop,
        encoder_ms=encoder_ms,
        command=f"mavbridge evaluate {flags}",
        checkpoint_sha256=sha256(weights),
        episodes=episodes,
        success=success["value"],
        success_low=success["low"],
        success_high=success["high"],
        gates=summary["gates_passed"]["value"],
        speed_mps=speed["value"] if speed else 0.0,
    )


def sha256(path: Path) -> str:
    """Return the hash of a file in hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def print_cells(cells: list[Cell]) -> None:
    """Print the map as a table."""
    rows = [
        (
            *(one.control, f"{one.encoder_ms} ms", one.loop, f"{one.success:.0%}"),
            f"{one.success_low:.0%} to {one.success_high:.0%}",
            *(f"{one.gates:.1f}", f"{one.speed_mps:.1f}"),
        )
        for one in cells
    ]
    header = ("controlled", "encoder", "loop", "courses flown", "95 %", "gates", "m/s")
    table_console().print(make_table("Held-out courses", header, rows))


def draw(cells: list[Cell], path: Path) -> None:
    """Write a PNG of success over encoding time: one panel per control, one line per loop."""
    from matplotlib import style
    from matplotlib.figure import Figure

    with style.context(FIGURE_STYLE):
        rows = math.ceil(len(CONTROLS) / PANELS_A_ROW)
        size = (6.0 * PANELS_A_ROW, 4.6 * rows)
        figure = Figure(figsize=size, dpi=FIGURE_DPI, facecolor="white")
        panels = figure.subplots(rows, PANELS_A_ROW, sharey=True).ravel()
        for axes, control in zip(panels, CONTROLS, strict=True):
            for loop, colour in zip(LOOPS, (MUTED, BLUE, RED), strict=True):
                of_loop = [c for c in cells if (c.control, c.loop) == (control.name, loop)]
                draw_loop(axes, of_loop, colour)
            axes.set_xscale("log")
            axes.set_xticks(ENCODER_MS, [str(ms) for ms in ENCODER_MS])
            axes.minorticks_off()
            axes.set_xlim(0.85 * ENCODER_MS[0], 1.18 * ENCODER_MS[-1])
            axes.set_ylim(-3, 103)
            axes.set_xlabel("encoder [ms an image]")
            axes.set_title(control.name)
            axes.legend(loc="lower left")
        panels[0].set_ylabel("courses flown [%], 95 % interval")
        figure.tight_layout(w_pad=3)
        figure.savefig(path)


def draw_loop(axes: Any, cells: list[Cell], colour: str) -> None:
    """Draw success [%] over encoding time, with its interval."""
    at = [cell.encoder_ms for cell in cells]
    low, high = ([100 * getattr(c, f"success_{end}") for c in cells] for end in ("low", "high"))
    axes.fill_between(at, low, high, color=colour, alpha=0.12, linewidth=0)
    label = cells[0].loop if cells[0].loop == "one rate" else f"two rates, {cells[0].loop}"
    axes.plot(at, [100 * cell.success for cell in cells], "o-", color=colour, label=label)


if __name__ == "__main__":
    app()
