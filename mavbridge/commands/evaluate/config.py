"""Settings of ``mavbridge evaluate``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from cyclopts import Parameter

from mavbridge.config.checks import check_range
from mavbridge.config.courses import (
    MAX_EPISODES,
    MAX_EVALUATION_SEED,
    AutopilotKind,
    ConditionsKind,
    CourseKind,
)
from mavbridge.config.flight import Limits
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.config.workers import WorkersConfig
from mavbridge.core.errors import UserError

ClockKind = Literal["simulated", "wall"]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """One evaluation: many courses that no policy was trained on."""

    policy: PolicyConfig = field(default_factory=PolicyConfig)
    limits: Limits = field(default_factory=Limits)
    visual_rate: float | str = 30.0
    """Most frames a second through the image encoder (dual rate), or auto[:MIN:MAX]."""
    action_rate: float | None = None
    """Most chunks of actions a second (dual rate): by default 100, or 2 for each time that the
    policy is meant to play a chunk."""
    rate: float | None = None
    """The same in single-rate mode: by default 30, or likewise."""
    episodes: int = 20
    """Courses to fly."""
    max_time: float = 60.0
    """Seconds that a flight may take, from the policy's first action."""
    courses: CourseKind = "easy"
    """easy, or race: longer, with sharper turns, climbs and dives."""
    conditions: ConditionsKind = "nominal"
    """random: each flight has another vehicle, firmware settings, wind, light, colours and lens.
    held-out: the same, and a look that no demonstration has: gates partly hidden, in shadow, at
    night, against the sun, or beside others that are out of order."""
    autopilot: AutopilotKind = "ardupilot"
    """Firmware of the bundled flight controller: its modes, stick curves and airframe."""
    gains: float = 1.0
    """Factor on the lean, yaw rate and climb of ArduPilot at full stick (simulated clock)."""
    gusts: float | None = None
    """Gusts of this many m/s (standard deviation) along each horizontal axis, in place of those of
    --conditions (simulated clock)."""
    raw_sticks: bool = False
    """Send the policy's sticks as they are, whatever the vehicle's curves make of them."""
    clock: ClockKind = "simulated"
    """simulated: bridge and simulator in lockstep, faster than real time, the same for the same
    seed. wall: real processes over UDP in real time, one flight at a time."""
    vision_delay: float = 0.0
    """Milliseconds added to the encoding of each image (simulated clock); an image older than
    --max-feature-age is not flown by. Here such limits may also be looser than the policy's."""
    vision_time: float | None = None
    """Milliseconds that an image takes to encode, always (simulated clock); by default as on two
    shared cores: 11, and 25 at the 99th percentile."""
    stalls: float = 0.0
    """Milliseconds for which the flight process stands still, at a random moment every 3 s
    (simulated clock); --max-stall may be looser than the policy's here, too."""
    workers: WorkersConfig = field(default_factory=WorkersConfig)
    json: Path | None = None
    """Write all results here as JSON."""
    resume: bool = False
    """Go on with the flights that --json holds, if they were flown by the same flags, weights and
    versions; the file is written anew after each flight."""
    plot: Path | None = None
    """Draw the results here as PNG; needs matplotlib (the extra "bench")."""

    def __post_init__(self) -> None:
        """Refuse values out of range, and contradictions."""
        check_range("episodes", self.episodes, 1, MAX_EPISODES, "")
        check_range("max-time", self.max_time, 1, 3600, "s")
        check_range("vision-delay", self.vision_delay, 0, 5000, "ms")
        check_range("stalls", self.stalls, 0, 5000, "ms")
        if self.resume and self.json is None:
            raise UserError("--resume needs the --json FILE to go on with")
        if self.vision_time is not None:
            check_range("vision-time", self.vision_time, 0, 5000, "ms")
        check_range("gains", self.gains, 0.2, 2.5, "")
        check_range("seed", self.policy.seed, 0, MAX_EVALUATION_SEED, "")
        if self.gains != 1 and (self.is_wall_clock or self.autopilot != "ardupilot"):
            raise UserError("--gains needs --clock simulated and --autopilot ardupilot")
        if self.gusts is not None:
            check_range("gusts", self.gusts, 0, 10, "m/s")
            if self.is_wall_clock:
                raise UserError("--gusts needs --clock simulated")
        has_vision = bool(self.vision_delay) or self.vision_time is not None
        if self.is_wall_clock and (has_vision or self.stalls):
            raise UserError(
                "--vision-delay, --vision-time and --stalls need --clock simulated: real encoders "
                "take their time"
            )
        if self.is_wall_clock and self.workers.is_parallel:
            raise UserError(
                "--clock wall flies one episode at a time, which needs the processors for itself: "
                "leave out --workers and --ray"
            )
        _ = self.rates

    @property
    def is_wall_clock(self) -> bool:
        """Flights take real time."""
        return self.clock == "wall"

    @property
    def rates(self) -> Rates:
        """Rates of ``mavbridge fly``."""
        return Rates(visual_rate=self.visual_rate, action_rate=self.action_rate, rate=self.rate)
