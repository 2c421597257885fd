"""Settings of ``mavbridge imagine``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from mavbridge.config.checks import check_range
from mavbridge.config.policy import PolicyConfig

DeciderName = Literal["toge", "world-model"]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ImagineConfig:
    """Settings of one imagined flight."""

    start: Path
    """Recorded flight that the imagination continues."""
    out: Path
    """Video to write (.mp4), new; its rows go beside it (.parquet)."""
    decider: DeciderName = "world-model"
    """Source of the sticks: the world model itself, or toge, the policy of --checkpoint."""
    world_model: Path | None = None
    """Weights of the world model; by default those that come with mavbridge."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    start_at: float = 0.0
    """Seconds into the flight, from its first frame with a state."""
    n_iter: int = 8
    """Iterations: a decision, and a simulation of its consequences."""
    exe_steps: int = 1
    """Steps that are executed before the next decision."""
    frames: int | None = None
    """Imagined frames that a segment of the video holds; by default the executed ones."""
    ddim_steps: int = 4
    """DDIM steps of the world model."""
    decode_video: bool = True
    """Write a video; without it only the rows are written."""
    fast_policy_no_decode: bool = False
    """Let the world model decide from its latents, without decoding and encoding them again."""
    serial: bool = False
    """Take the plain way, for comparison: decode everything at once, write it all at the end."""
    rerun: Annotated[str, Parameter(help="spawn, connect[=URL], FILE.rrd, or off.")] = "off"

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range("start-at", self.start_at, 0, 86400, "s")
        check_range("n-iter", self.n_iter, 1, 1_000_000, "")
        if self.frames is not None:
            check_range("frames", self.frames, 1, 256, "")
        check_range("exe-steps", self.exe_steps, 1, 256, "")
        check_range("ddim-steps", self.ddim_steps, 1, 1000, "")
