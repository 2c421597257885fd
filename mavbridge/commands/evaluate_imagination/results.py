"""Results of an evaluation of a world model: frozen values, their JSON, and tables of them."""

import json
from dataclasses import asdict, dataclass
from typing import Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mavbridge.commands.evaluate.statistics import Estimate
from mavbridge.commands.output import make_table, number

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
    """Imagined body rates against those of the vehicle, which flew the recorded sticks.

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
    flights_too_short: int
    demonstrations_failed: int
    asked_windows: int
    damage: tuple[str, ...] = ()
    """What of the flights was skipped, in sentences for the user."""


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


def _frames_table(quality: ImaginationQuality) -> Table:
    dt_s = quality.given.frame_dt_s
    steps = sorted({one.step for one in quality.frames})
    rows = [
        (method, *(f"{one.psnr_db:.2f}" for one in quality.frames if one.method == method))
        for method in METHODS
    ]
    header = ("", *(f"{step} ({step * dt_s:.1f} s)" for step in steps))
    return make_table("frames: PSNR in dB, by frames ahead", header, rows)


def _following_table(quality: ImaginationQuality) -> Table:
    rows = [
        (one.axis, one.source, number(one.slope, 2), number(one.spearman, 2), str(one.pairs))
        for one in quality.stick_following
    ]
    title = "body rates against the vehicle's: are the sticks followed?"
    return make_table(title, ("axis", "of", "slope", "Spearman", "steps"), rows, left_columns=2)


def _drift_table(quality: ImaginationQuality) -> Table:
    steps = quality.given.exe_steps
    rows = []
    for one in quality.drift:
        values_db = (one.imagined_psnr_db, one.autoencoder_psnr_db, one.copy_last_psnr_db)
        end = f"{one.iteration} ({one.iteration * steps * quality.given.frame_dt_s:.1f} s)"
        rows.append((end, *(f"{value:.2f}" for value in values_db), str(one.chains)))
    title = f"drift: chained iterations of {steps} frames, PSNR in dB of the last"
    return make_table(title, ("iteration", *METHODS, "chains"), rows)
