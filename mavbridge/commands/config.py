"""Settings of the commands; those of evaluate, record and replay are in their packages."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from mavbridge.config.checks import check_range
from mavbridge.config.courses import (
    CHECK_COURSE_SEED,
    MAX_EPISODES,
    AutopilotKind,
    CourseKind,
    first_seed,
)
from mavbridge.config.flight import FlyConfig
from mavbridge.config.groups import OUTPUT, RATES, VEHICLE
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.workers import WorkersConfig
from mavbridge.core.errors import UserError

DeciderName = Literal["toge", "world-model"]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ContractConfig:
    """Settings of ``mavbridge contract``."""

    out: Path | None = None
    """The file to write, new; by default mavbridge.toml in the folder, where flights find it."""
    dataset: Path | None = None
    """The LeRobot dataset that the policy was trained on; by default the one that LeRobot's
    training noted beside the policy, if it is here."""


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


ExportFormat = Literal["onnx", "torchscript"]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ExportPolicyConfig:
    """What is written, and where."""

    out: Path
    """Folder for encoder.onnx, denoiser.onnx and policy.json; or the archive's file, .pt."""
    format: ExportFormat = "onnx"
    """onnx: encoder, one denoising step, contract and schedule. torchscript: the same in one
    archive."""
    policy: str = "toge"
    """Kind of the policy: toge or resnet-unet."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class IdentifyConfig:
    """One flight of the doublet; policy and checkpoint are what it is compared with."""

    flight: FlyConfig = field(default_factory=FlyConfig)
    mapped_sticks: Annotated[bool, Parameter(negative="", group=OUTPUT)] = False
    """Send the sticks through the inverse of the vehicle's curves, as a flight does; by default the
    vehicle's own gains are measured."""
    json: Annotated[Path | None, Parameter(group=OUTPUT)] = None
    """Write all figures here as JSON."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ServeConfig:
    """One policy, and where it is served."""

    policy: PolicyConfig = field(default_factory=PolicyConfig)
    host: str = "127.0.0.1"
    """Address to listen at; by default this computer's own clients only. 0.0.0.0 is every network
    that it is in: set MAVBRIDGE_API_KEY then, on both sides."""
    port: int = 8000
    """Port to listen at."""

    def __post_init__(self) -> None:
        """Refuse what cannot be served."""
        object.__setattr__(self, "host", self.host.removeprefix("[").removesuffix("]"))
        check_range("port", self.port, 1, 65535, "")
        if self.policy.dual_rate:
            raise UserError("each request is answered from its own image: leave out --dual-rate")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class CheckConfig:
    """The flight to check, by its own flags."""

    flight: FlyConfig = field(default_factory=FlyConfig)
    echo_test: Annotated[bool, Parameter(negative="", group=VEHICLE)] = False
    """Send neutral sticks for up to three seconds, only while disarmed, and see whether the vehicle
    takes them from our system id; then release them."""
    timing: Annotated[float, Parameter(group=RATES)] = 3.0
    """Seconds for which the policy is run at its rates, on one dummy sample; minutes show whether
    this computer throttles."""
    json: Annotated[Path | None, Parameter(group=OUTPUT, allow_leading_hyphen=True)] = None
    """Write the rows here as JSON; - is standard output, and the table then goes to standard
    error."""

    def __post_init__(self) -> None:
        """Refuse durations that show nothing."""
        check_range("timing", self.timing, 0.5, 36_000, "s")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """Settings of ``mavbridge export``."""

    out: Path
    """Folder for the dataset, new or empty."""
    task: str = "fly"
    """Task of the flights, in words, for policies that are given one."""
    include_failed: Annotated[bool, Parameter(negative="")] = False
    """Export flights, too, that crashed, ended by a fault, were marked as bad, or missed gates."""
    image_size: int | None = None
    """Height and width of the images, as the policy is to see them; by default as recorded."""
    state: Literal["world", "body"] = "world"
    """Velocity and attitude in world axes, which mavbridge train takes; or velocity and the
    vertical in body axes, the same on every heading, which other networks learn from sooner."""

    def __post_init__(self) -> None:
        """Refuse an empty task, and a size that a video cannot have."""
        size = self.image_size
        if size is not None and (size % 2 or not 16 <= size <= 4096):
            raise UserError(f"--image-size {size}: an even number from 16 to 4096")
        if not self.task.strip():
            raise UserError("--task is empty: describe what the flights do")


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


@Parameter(name="*", group=OUTPUT)
@dataclass(frozen=True, kw_only=True)
class InspectConfig:
    """What is made of recorded flights, besides the tables on the terminal."""

    html: Path | None = None
    """Write one page with the plots, the path, the worst moments and the video in it."""
    json: Path | None = None
    """Write the figures as JSON: a list with an object for each flight."""
    rerun: str = "off"
    """Show the flight in the Rerun viewer: spawn, connect[=URL], FILE.rrd, or off."""
    gates: Path | None = None
    """Draw the gates of this file, that of python -m sitl course --json; a recording by the
    simulator knows its own."""
