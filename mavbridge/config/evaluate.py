"""Settings of ``mavbridge evaluate``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from mavbridge.config.checks import check_range
from mavbridge.config.courses import MAX_EPISODES
from mavbridge.config.flight import Limits
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.errors import UserError

Variety = Literal["nominal", "random"]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """One evaluation: many courses that no policy was trained on."""

    policy: PolicyConfig = field(default_factory=PolicyConfig)
    limits: Limits = field(default_factory=Limits)
    visual_rate: float | str = 30.0
    """Most frames a second through the image encoder (dual rate), or auto[:MIN:MAX]."""
    action_rate: float = 100.0
    """Commands a second (dual rate)."""
    rate: float = 30.0
    """Commands a second in single-rate mode."""
    episodes: int = 20
    """Courses to fly."""
    max_time: float = 60.0
    """Seconds that a flight may take, from the policy's first action."""
    conditions: Variety = "nominal"
    """random: each flight has another vehicle, firmware settings, wind, light, colours and lens."""
    vision_delay: float = 0.0
    """Milliseconds by which each image takes longer to encode, with --lockstep; images older than
    --max-feature-age are not flown by, whatever made them so."""
    realtime: Annotated[bool, Parameter(negative="--lockstep")] = False
    """--realtime: real processes over UDP against the wall clock, one flight at a time. --lockstep
    (default): bridge and simulator on one simulated clock, as fast as the processor allows."""
    workers: int = 1
    """Episodes at a time; more than 1 takes ray (the extra "cluster")."""
    ray: str | None = None
    """Ray cluster to use, as HOST:PORT or auto; by default one on this machine, if needed."""
    json: Path | None = None
    """Write all results here as JSON."""
    plot: Path | None = None
    """Draw the results here as PNG; needs matplotlib (the extra "bench")."""

    def __post_init__(self) -> None:
        """Refuse contradictions."""
        check_range("episodes", self.episodes, 1, MAX_EPISODES, "")
        check_range("max-time", self.max_time, 1, 3600, "s")
        check_range("workers", self.workers, 1, 10_000, "")
        check_range("vision-delay", self.vision_delay, 0, 5000, "ms")
        if self.realtime and self.vision_delay:
            raise UserError(
                "--realtime takes the time that it takes: --vision-delay is for --lockstep"
            )
        if self.realtime and (self.workers > 1 or self.ray is not None):
            raise UserError(
                "--realtime flies one episode at a time, since the processors must be its own: "
                "leave out --workers and --ray"
            )
        _ = self.rates

    @property
    def rates(self) -> Rates:
        """As ``fly`` takes them."""
        return Rates(visual_rate=self.visual_rate, action_rate=self.action_rate, rate=self.rate)
