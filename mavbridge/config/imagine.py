"""Settings of ``mavbridge imagine``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from mavbridge.config.checks import check_range
from mavbridge.config.policy import PolicyConfig

Decider = Literal["toge", "world-model"]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ImagineConfig:
    """One imagined flight."""

    start: Path
    """Recorded flight that the imagination goes on from."""
    out: Path
    """Video to write (.mp4), new; its rows go beside it (.parquet)."""
    decider: Decider = "world-model"
    """Who chooses the sticks: the world model itself, or toge, the policy of --checkpoint."""
    world_model: Path | None = None
    """Weights of the world model; by default those that come with mavbridge."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    start_at: float = 0.0
    """Seconds into the flight, from its first frame with a state."""
    n_iter: int = 8
    """Iterations: a decision, and a simulation of what comes of it."""
    frames: int = 16
    """Imagined frames of each iteration that are shown."""
    exe_steps: int = 1
    """Steps that are executed before the next decision; --frames 1 shows these alone."""
    ddim_steps: int = 4
    """DDIM steps of the world model."""
    decode_video: bool = True
    """Write a video; without it only the rows are written."""
    fast_policy_no_decode: bool = True
    """Let the world model decide from its latents; otherwise they are decoded and encoded again."""
    serial: bool = False
    """The plain path, for comparison: decode everything at once, write everything at the end."""
    rerun: Annotated[str, Parameter(help="spawn, connect[=URL], FILE.rrd, or off.")] = "off"

    def __post_init__(self) -> None:
        """Refuse what no world model could do."""
        check_range("start-at", self.start_at, 0, 86400, "s")
        check_range("n-iter", self.n_iter, 1, 1_000_000, "")
        check_range("frames", self.frames, 1, 256, "")
        check_range("exe-steps", self.exe_steps, 1, 256, "")
        check_range("ddim-steps", self.ddim_steps, 1, 1000, "")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ImagineEvaluateConfig:
    """How good a world model is, on recorded flights."""

    world_model: Path | None = None
    """Weights of the world model; by default those that come with mavbridge."""
    ddim_steps: int = 4
    """DDIM steps of the world model."""
    windows: int = 64
    """Runs of frames to imagine, evenly spaced over the flights."""
    chains: int = 16
    """Runs of 10 iterations, each going on from the last imagined frames, evenly spaced, too."""
    exe_steps: int | None = None
    """Frames of a chain's iteration; by default all that the model imagines."""
    fov: float = 90.0
    """Horizontal field of view in degrees, of flights that do not tell theirs."""
    camera_tilt: float = 10.0
    """Degrees that the camera looks up, of flights that do not tell theirs."""
    yaw_rate: float = 202.5
    """Degrees a second at full yaw stick, of flights that do not tell theirs."""
    device: str = "cpu"
    """torch device: cpu, cuda, cuda:1, mps."""
    seed: int = 0
    """Of the noise that the imagination starts from."""
    json: Path | None = None
    """Write all figures here as JSON."""

    def __post_init__(self) -> None:
        """Refuse what cannot be evaluated."""
        check_range("ddim-steps", self.ddim_steps, 1, 1000, "")
        check_range("windows", self.windows, 1, 10_000, "")
        check_range("chains", self.chains, 1, 10_000, "")
        if self.exe_steps is not None:
            check_range("exe-steps", self.exe_steps, 1, 256, "")
        check_range("fov", self.fov, 10, 170, "degrees")
        check_range("camera-tilt", self.camera_tilt, -90, 90, "degrees")
        check_range("yaw-rate", self.yaw_rate, 1, 2000, "degrees/s")
        check_range("seed", self.seed, 0, 2**63 - 1, "")
