"""Results of an evaluation of a world model: frozen values, their JSON, and tables of them."""

import json
from dataclasses import asdict, dataclass
from typing import Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mavbridge.commands.evaluate.statistics import Estimate

Method = Literal["imagined", "autoencoder only", "copy last"]
METHODS: tuple[Method, ...] = ("imagined", "autoencoder only", "copy last")
Axis = Literal["roll", "pitch", "yaw"]
AXES: tuple[Axis, ...] = ("roll", "pitch", "yaw")
"""In the order of body rates."""
RateSource = Literal["real states", "imagined states", "imagined states, sticks swapped"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameQuality:
    """Likeness of one method's frames to the real ones, so many steps ahead: mean of windows."""

    method: Method
    step: int
    psnr_db: float


@dataclass(frozen=True, slots=True, kw_only=True)
class StickFollowing:
    """Imagined body rates against those of the vehicle, which obeyed the recorded sticks.

    Slope and rank correlation of 1 are perfect. With the sticks of another window both are near 0
    in a model that follows its sticks, and as high as with its own in one that ignores them.
    """

    axis: Axis
    source: RateSource
    slope: float | None
    spearman: float | None
    pairs: int


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftIteration:
    """Frames at the end of one iteration, mean of all chains."""

    iteration: int
    chains: int
    imagined_psnr_db: float
    autoencoder_psnr_db: float
    copy_last_psnr_db: float
    """PSNR of the last frame before the chain began."""


@dataclass(frozen=True, kw_only=True)
class Given:
    """Settings of the evaluation and its flights."""

    world_model: str
    ddim_steps: int
    seed: int
    frame_dt_s: float
    exe_steps: int
    flights: int
    """Flights that are long enough for a window."""
    flights_too_short: int
    demonstrations_failed: int
    asked_windows: int


@dataclass(frozen=True, kw_only=True)
class ImaginationQuality:
    """One evaluation; parts of it are empty if it was interrupted."""

    given: Given
    windows: int
    frames: tuple[FrameQuality, ...]
    stick_following: tuple[StickFollowing, ...]
    own_actions_nearer: Estimate | None
    """Share of windows whose latents, imagined with the sticks that were sent, are nearer to the
    real ones than those imagined with the sticks of another window."""
    drift: tuple[DriftIteration, ...]


def to_json(quality: ImaginationQuality) -> str:
    """Everything as JSON."""
    return json.dumps(asdict(quality), indent=2, allow_nan=False) + "\n"


def print_quality(quality: ImaginationQuality, console: Console) -> None:
    """Print what was evaluated, then a table for each part that there is."""
    given = quality.given
    console.print(
        Text(
            f"{given.world_model}, {given.ddim_steps} DDIM steps, seed {given.seed}: "
            f"{quality.windows} windows of {given.flights} flights; left out: "
            f"{given.flights_too_short} too short, {given.demonstrations_failed} demonstrations "
            "that failed"
        ),
        soft_wrap=True,
    )
    if quality.frames:
        console.print(_frames_table(quality))
        console.print(_following_table(quality))
    if (nearer := quality.own_actions_nearer) is not None:
        console.print(
            Text(
                f"action swap: with its own sticks {nearer.value:.1%} of {nearer.count} windows "
                f"(95 % interval {nearer.low:.1%} to {nearer.high:.1%}) come nearer to what "
                "happened than with another window's; 50 % would be chance"
            ),
            soft_wrap=True,
        )
    if quality.drift:
        console.print(_drift_table(quality))


def _table(title: str, texts: int, headings: list[str]) -> Table:
    """A table whose first columns hold text, and the others numbers."""
    table = Table(title=title)
    for column, heading in enumerate(headings):
        table.add_column(heading, justify="left" if column < texts else "right")
    return table


def _frames_table(quality: ImaginationQuality) -> Table:
    dt_s = quality.given.frame_dt_s
    steps = sorted({one.step for one in quality.frames})
    headings = ["", *(f"{step} ({step * dt_s:.1f} s)" for step in steps)]
    table = _table("frames: PSNR in dB, by frames ahead", 1, headings)
    for method in METHODS:
        rows = (one for one in quality.frames if one.method == method)
        table.add_row(method, *(f"{one.psnr_db:.2f}" for one in rows))
    return table


def _following_table(quality: ImaginationQuality) -> Table:
    headings = ["axis", "of", "slope", "Spearman", "steps"]
    table = _table("body rates against the vehicle's: are the sticks followed?", 2, headings)
    for one in quality.stick_following:
        numbers = ("-" if v is None else f"{v:.2f}" for v in (one.slope, one.spearman))
        table.add_row(one.axis, one.source, *numbers, str(one.pairs))
    return table


def _drift_table(quality: ImaginationQuality) -> Table:
    given = quality.given
    title = f"drift: chained iterations of {given.exe_steps} frames, PSNR in dB of the last"
    table = _table(title, 0, ["iteration", *METHODS, "chains"])
    for one in quality.drift:
        values = (one.imagined_psnr_db, one.autoencoder_psnr_db, one.copy_last_psnr_db)
        table.add_row(
            f"{one.iteration} ({one.iteration * given.exe_steps * given.frame_dt_s:.1f} s)",
            *(f"{value:.2f}" for value in values),
            str(one.chains),
        )
    return table
