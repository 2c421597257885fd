"""Settings of ``mavbridge demonstrate``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from cyclopts import Parameter

from mavbridge.config.checks import check_range
from mavbridge.config.courses import (
    CHECK_COURSE_SEED,
    MAX_EPISODES,
    AutopilotKind,
    CourseKind,
    first_seed,
)
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.workers import WorkersConfig


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DemonstrateConfig:
    """Flights to learn from."""

    out: Path
    """Folder for the flights, each in a folder of its own; finished ones are kept."""
    episodes: int = 100
    """Flights in all."""
    speed: float = 5.0
    """Speed of the expert along the course, in m/s; 1.5 to 10 by sticks, to 14 by rates."""
    action: Literal["sticks", "rates"] = "sticks"
    """What the expert flies by: sticks in ALT_HOLD, or thrust and body rates."""
    autopilot: AutopilotKind = "ardupilot"
    """Firmware of the bundled flight controller: its modes, stick curves and airframe."""
    courses: CourseKind = "easy"
    """easy, or race: longer, with sharper turns, climbs and dives."""
    max_time: float = 40.0
    """Seconds after which a flight ends, on the course or not; a short one can start a rollout."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """With --checkpoint the policy flies most of the time, and the expert's actions are recorded as
    labels (DAgger)."""
    workers: WorkersConfig = field(default_factory=WorkersConfig)

    def __post_init__(self) -> None:
        """Refuse what cannot be flown."""
        check_range("episodes", self.episodes, 1, MAX_EPISODES, "")
        check_range("speed", self.speed, 1.5, 14 if self.action == "rates" else 10, "m/s")
        check_range("max-time", self.max_time, 1, 3600, "s")
        check_range("seed", self.policy.seed, 0, CHECK_COURSE_SEED // MAX_EPISODES - 1, "")

    @property
    def first_course_seed(self) -> int:
        """Course of the first flight; neither training nor evaluation flies any of these."""
        return first_seed(self.courses) + self.policy.seed * MAX_EPISODES
