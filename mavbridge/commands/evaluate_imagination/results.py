"""What an evaluation of a world model found: frozen values, and their JSON."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Literal

from mavbridge.commands.evaluate.statistics import Estimate

Method = Literal["imagined", "autoencoder only", "copy last", "gyro warp"]
METHODS: tuple[Method, ...] = ("imagined", "autoencoder only", "copy last", "gyro warp")
Axis = Literal["yaw", "pitch", "roll"]
AXES: tuple[Axis, ...] = ("roll", "pitch", "yaw")
"""In the order of body rates."""
Teller = Literal["real states", "imagined states", "real frames", "imagined frames"]
TELLERS: tuple[Teller, ...] = ("real states", "imagined states", "real frames", "imagined frames")
Reference = Literal["stick", "real states"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameQuality:
    """How like the real frames those of one method are, so many steps ahead: means of windows."""

    method: Method
    step: int
    psnr_db: float
    ssim: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Obedience:
    """How one source of body rates follows another; 1 and 1 would be perfect."""

    axis: Axis
    reference: Reference
    """stick: times the yaw rate of a full stick, whatever its dead zone and expo. Roll and pitch
    sticks ask for angles, not rates, in the modes that are flown: no row has them."""
    teller: Teller
    """Frames: recovered from pixels, so "real frames" says what that method itself is worth."""
    slope: float | None
    spearman: float | None
    pairs: int


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftIteration:
    """One iteration of all chains, at its last executed frame."""

    iteration: int
    """From 1."""
    chains: int
    """Imagined."""
    scored: int
    """Of them, those whose flight has a real frame there; the PSNRs are of these."""
    imagined_psnr_db: float | None
    autoencoder_psnr_db: float | None
    copy_last_psnr_db: float | None
    """Of the last frame before the chain began."""
    left_range: float
    """Share of the chains whose latents are unlike any real ones."""


@dataclass(frozen=True, kw_only=True)
class Given:
    """What was evaluated, and on what."""

    world_model: str
    ddim_steps: int
    seed: int
    frame_dt_s: float
    exe_steps: int
    """Of a chain's iteration."""
    flights: int
    """That windows were taken from or could have been."""
    flights_too_short: int
    demonstrations_failed: int
    """Left out, as in training."""
    flights_with_assumed_lens: int
    flights_with_assumed_yaw_rate: int
    asked_windows: int


@dataclass(frozen=True, kw_only=True)
class Quality:
    """One run of ``mavbridge imagine --evaluate``; less of it if it was interrupted."""

    given: Given
    windows: int
    """Scored."""
    frames: tuple[FrameQuality, ...]
    obedience: tuple[Obedience, ...]
    own_actions_nearer: Estimate | None
    """Share of windows whose latents, imagined with the sticks that were sent, are nearer to the
    real ones than those imagined with the sticks of another window."""
    drift: tuple[DriftIteration, ...]

    def of(self, method: Method) -> Sequence[FrameQuality]:
        """One method, the nearest step first."""
        return [one for one in self.frames if one.method == method]


def to_json(quality: Quality) -> str:
    """Everything as JSON."""
    return json.dumps(asdict(quality), indent=2, allow_nan=False) + "\n"
