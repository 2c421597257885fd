"""Settings of the commands that fly simulated episodes, and the seeds of their courses."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from mavbridge.config.flags import Ranged, check_range
from mavbridge.config.flight import Limits
from mavbridge.config.policy import PolicyConfig, Rates
from mavbridge.core.errors import UserError
from policy.contract import StateTime
from policy.fields import Between
from policy.nets.names import BUILTIN_KINDS

AutopilotKind = Literal["ardupilot", "px4"]
CourseKind = Literal["easy", "race", "loop"]
"""Families of courses, each with its own seeds and the same ranges of them."""
ConditionsKind = Literal["nominal", "random", "held-out", "unseen"]
"""Vehicles, wind and light: constant, drawn at random, or with looks that no demonstration has."""

COURSE_SEEDS: dict[CourseKind, int] = {"easy": 0, "race": 1_000_000_000, "loop": 2_000_000_000}
"""First seed of each family (`sitl.course`)."""

HELD_OUT_COURSE_SEED = 1_000_000
"""First seed of the evaluation's courses; nothing is ever trained on them."""

MAX_EPISODES = 10_000
"""Most episodes per evaluation, so that different seeds never share courses."""
_EXPERTS = ("seed", "image_size", "dual_rate")
"""Settings of a policy that a demonstration uses without a student, or checks itself."""

MAX_EVALUATION_SEED = (COURSE_SEEDS["race"] - HELD_OUT_COURSE_SEED) // MAX_EPISODES - 1
"""Beyond this seed, easy courses would be race courses, some of them trained on."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class WorkersConfig(Ranged):
    """Number of episodes flown at a time, and the machines that fly them."""

    workers: Annotated[int, Between(1, 10_000)] = 1
    """Episodes at a time, each in a process of its own."""
    ray: Annotated[
        bool | str, Parameter(negative="", show_default=False, metavar="[HOST:PORT]")
    ] = False
    """Fly on the Ray cluster that this machine belongs to, or on the one at HOST:PORT. Its machines
    must share the folders of files that are read and written. Needs the extra "cluster"."""

    @property
    def ray_address(self) -> str | None:
        """Address as Ray takes it; None: no cluster."""
        return "auto" if self.ray is True else self.ray or None


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(Ranged):
    """One evaluation: many courses that no policy was trained on."""

    policy: PolicyConfig = field(default_factory=PolicyConfig)
    limits: Limits = field(default_factory=Limits)
    rates: Rates = field(default_factory=Rates)
    episodes: Annotated[int, Between(1, MAX_EPISODES)] = 20
    """Courses to fly."""
    max_time: Annotated[float, Between(1, 3600, "s")] = 60.0
    """Seconds that a flight may take, from the policy's first action."""
    courses: CourseKind = "easy"
    """easy; race: longer, with sharper turns, climbs and dives; loop: gates around a circle."""
    laps: Annotated[int, Between(1, 1000)] = 1
    """Rounds of a loop."""
    hover: Annotated[float, Between(0, 3600, "s")] = 1.0
    """Seconds to fly on after the last gate; the drift from where it stopped is told."""
    conditions: ConditionsKind = "nominal"
    """random: each flight has another vehicle, firmware settings, wind, light, colours and lens.
    held-out: the same, and a look that no demonstration has: gates partly hidden, in shadow, at
    night, against the sun, or beside others that are out of order. unseen: in fog, or through a
    dirty lens."""
    autopilot: AutopilotKind = "ardupilot"
    """Firmware of the bundled flight controller: its modes, stick curves and airframe."""
    gains: Annotated[float, Between(0.2, 2.5)] = 1.0
    """Factor on the lean, yaw rate and climb of ArduPilot at full stick."""
    gusts: Annotated[float | None, Between(0, 10, "m/s")] = None
    """Standard deviation of horizontal gusts, in m/s. Each axis has its own; they replace those of
    --conditions."""
    vision_delay: Annotated[float, Between(0, 5000, "ms")] = 0.0
    """Milliseconds added to the encoding of each image; an image older than
    limits.feature_age is not flown by. Here such limits may also be looser than the policy's."""
    vision_time: Annotated[float | None, Between(0, 5000, "ms")] = None
    """Milliseconds that an image takes to encode, always; by default as on two shared
    cores: 11, and 25 at the 99th percentile."""
    solve_time: Annotated[float | None, Between(0, 5000, "ms")] = None
    """Milliseconds that a chunk takes, as from a slow head or a server; default: 3, and 6 at the
    99th percentile. The policy's play_s, and so its age limits and its rate, follow."""
    state_time: StateTime | None = None
    """measured, or execution (predicted to when the chunk acts); default: the contract's."""
    stalls: Annotated[float, Between(0, 5000, "ms")] = 0.0
    """Milliseconds for which the flight process stands still, at a random moment every 3 s;
    limits.stall may be looser than the policy's here, too."""
    workers: WorkersConfig = field(default_factory=WorkersConfig)
    json: Path | None = None
    """Write all results here as JSON."""
    resume: bool = False
    """Go on with the flights that --json holds. They must have been flown by the same flags,
    weights and versions; the file is written anew after each flight."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.laps > 1 and self.courses != "loop":
            raise UserError("--laps needs --courses loop")
        if self.resume and self.json is None:
            raise UserError("--resume needs the --json FILE to go on with")
        check_range("seed", self.policy.seed, 0, MAX_EVALUATION_SEED, "")
        if self.gains != 1 and self.autopilot != "ardupilot":
            raise UserError("--gains needs --autopilot ardupilot")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DemonstrateConfig(Ranged):
    """Demonstrations to learn from."""

    out: Path
    """Folder for the flights, each in a folder of its own; finished ones are kept."""
    episodes: Annotated[int, Between(1, MAX_EPISODES)] = 100
    """Flights in all."""
    speed: float = 5.0
    """Speed of the expert along the course, in m/s; 1.5 to 10 by sticks, to 14 by rates."""
    action: Literal["sticks", "rates"] = "sticks"
    """What the expert flies by: sticks in ALT_HOLD, or thrust and body rates."""
    autopilot: AutopilotKind = "ardupilot"
    """Firmware of the bundled flight controller: its modes, stick curves and airframe."""
    courses: CourseKind = "easy"
    """easy; race: longer, with sharper turns, climbs and dives; loop: gates around a circle."""
    max_time: Annotated[float, Between(1, 3600, "s")] = 40.0
    """Seconds after which a flight ends, on the course or not; a short one can start a rollout."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """Student: with --checkpoint, or if it needs none (lerobot:DIR), it flies most of the time, and
    the expert's actions are recorded as labels (DAgger)."""
    solve_time: Annotated[float, Between(0, 1000, "ms")] = 0.0
    """Longest time for a student's chunk, in milliseconds. It then flies as a policy with a slow
    head or behind a server does; each flight draws its own time, from a quarter of this on."""
    workers: WorkersConfig = field(default_factory=WorkersConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("speed", self.speed, 1.5, 14 if self.action == "rates" else 10, "m/s")
        if self.policy.dual_rate is False:
            raise UserError("demonstrations are flown at two rates: leave out --single-rate")
        given = self.policy.given(*_EXPERTS) + ["solve_time"] * bool(self.solve_time)
        if not self.has_student and given:
            names = ", ".join(given).replace("_", " ")
            raise UserError(
                f"{names}: the expert has none; give the student's --checkpoint, or leave it out "
                "(the expert flies by rates with --action rates)"
            )
        check_range("seed", self.policy.seed, 0, HELD_OUT_COURSE_SEED // MAX_EPISODES - 1, "")

    @property
    def has_student(self) -> bool:
        """True if a policy flies; a built-in network needs ``checkpoint`` for that."""
        return self.policy.checkpoint is not None or self.policy.kind not in BUILTIN_KINDS
