"""Everything that can be set, as frozen dataclasses, and the only place that holds a rate in Hz.

The command line and the TOML file are both read into ``FlyConfig``: a field is a flag, its
docstring is the help text, an unknown key is an error.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from mavbridge.clock import NS_PER_S
from mavbridge.errors import UserError

Engine = Literal["auto", "torch", "openvino", "cuda-graph"]
Output = Literal["rc-override", "manual-control"]
Pace = Literal["clock", "state"]
Variety = Literal["nominal", "random"]
Decider = Literal["toge", "world-model"]

HEARTBEAT_HZ = 1.0
"""MAVLink heartbeat protocol; autopilots time a peer out after several seconds."""
RC_CHANNELS_HZ = 20.0
"""RC_CHANNELS for the echo check and the pilot's sticks; the check needs 10 Hz or more."""
TIMESYNC_HZ = 2.0
"""TIMESYNC requests; the minimum-delay filter wants a few a second."""
AUTO_VISUAL_HZ = (10.0, 60.0)
"""Limits of --visual-rate auto where none are given."""
STATE_HZ = 50.0
"""Least rate of telemetry to ask for, however slow the actions are: ages are limits in seconds."""
SIM_CAMERA_HZ = 30.0
"""Frames a second of the simulated camera, unless the visual rate asks for more."""
SIM_CAMERA_PX = 224
"""Side of its frames, as ``python -m sitl`` sends them: what a policy wants smaller is made smaller
by the bridge, as in a real flight, and not drawn smaller."""
STATUS_HZ = 5.0
"""Terminal refresh."""


def period_ns(rate_hz: float) -> int:
    """Period of a rate in integer nanoseconds."""
    return round(NS_PER_S / rate_hz)


def _check(name: str, value: float, low: float, high: float, unit: str) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        limits = f"{low:g} and {high:g} {unit}".rstrip()
        raise UserError(f"--{name} must be between {limits}, got {value:g}")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Rates:
    """Loop rates in Hz."""

    visual_rate: float | str = 30.0
    """Most frames a second through the image encoder (dual rate); auto[:MIN:MAX] looks more often
    when the vehicle turns or the image changes."""
    action_rate: float = 100.0
    """Commands a second (dual rate)."""
    rate: float = 30.0
    """Commands a second in single-rate mode, each with the newest image."""
    realtime: bool = True
    """Real-time scheduling of the action loop (SCHED_FIFO), where the system permits it."""
    action_cpu: int | None = None
    """Run the action loop on this CPU alone."""
    vision_cpu: int | None = None
    """Run the vision loop on this CPU alone."""
    pace: Pace = "clock"
    """clock: ticks on a fixed grid. state: a tick on each fresh attitude message, by the clock when
    none comes."""

    def __post_init__(self) -> None:
        """Refuse rates that no autopilot serves."""
        low_hz, high_hz = self.visual_limits_hz
        _check("visual-rate", low_hz, 0.5, high_hz, "Hz")
        _check("visual-rate", high_hz, low_hz, 240, "Hz")
        _check("action-rate", self.action_rate, 10, 500, "Hz")
        _check("rate", self.rate, 10, 500, "Hz")

    @property
    def visual_limits_hz(self) -> tuple[float, float]:
        """Least and most frames a second; equal where the rate is fixed."""
        if isinstance(self.visual_rate, float | int):
            return self.visual_rate, self.visual_rate
        kind, *limits = self.visual_rate.split(":")
        try:
            low_hz, high_hz = map(float, limits) if limits else AUTO_VISUAL_HZ
        except ValueError:
            low_hz, high_hz = math.nan, math.nan
        if kind != "auto" or math.isnan(low_hz) or math.isnan(high_hz):
            raise UserError(
                f"--visual-rate {self.visual_rate} is neither a rate in Hz nor auto[:MIN:MAX]"
            )
        return low_hz, high_hz


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Limits:
    """How old an input may be, and how fast a stick may move. Beyond it: released to the pilot."""

    max_attitude_age: float = 0.1
    """Oldest attitude and body rates to act on, in seconds."""
    max_velocity_age: float = 0.25
    """Oldest velocity and acceleration to act on, in seconds."""
    max_feature_age: float = 0.3
    """Oldest image feature to act on, in seconds since exposure."""
    tau: float = 0.05
    """Time constant of the stick low-pass, in seconds; 0 = off."""
    max_slew: float = 8.0
    """Fastest stick movement, in full deflections a second; 0 = no limit."""

    def __post_init__(self) -> None:
        """Refuse values that would switch a limit off by accident."""
        for name in ("max_attitude_age", "max_velocity_age", "max_feature_age"):
            _check(name.replace("_", "-"), getattr(self, name), 0.01, 5, "s")
        _check("tau", self.tau, 0, 2, "s")
        _check("max-slew", self.max_slew, 0, 1000, "1/s")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class LinkConfig:
    """The vehicle and how to reach it."""

    connect: str = ""
    """The vehicle: udp:HOST:PORT (listen), udpout:HOST:PORT, tcp:HOST:PORT, /dev/ttyX,BAUD."""
    source_system: int = 255
    """Our MAVLink system id; ArduPilot obeys overrides from its MAV_GCS_SYSID (255) only."""
    target_system: int = 0
    """System id of the vehicle to fly; 0 = the only one on the link."""
    connect_timeout: float = 30.0
    """Seconds to wait for the vehicle's first heartbeat."""
    output: Output = "rc-override"
    """RC_CHANNELS_OVERRIDE (ArduPilot) or MANUAL_CONTROL (PX4)."""
    readonly: bool = False
    """Run everything, send no stick, mode or arm command."""

    def __post_init__(self) -> None:
        """Refuse ids that MAVLink has no room for."""
        _check("source-system", self.source_system, 1, 255, "")
        _check("target-system", self.target_system, 0, 254, "")
        _check("connect-timeout", self.connect_timeout, 0.1, 3600, "s")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """What flies."""

    policy: str = "toge"
    """toge[:small|medium|large[:BACKBONE]], resnet-unet, scripted[:hover|square|circle|yaw],
    or your own package.module:Class."""
    checkpoint: Path | None = None
    """Weights: .safetensors with the contract in its header, or .pt; toge has shipped ones."""
    dual_rate: bool = False
    """Encode images in their own thread and sample actions faster from the cached feature."""
    num_diffusion_steps: int = 10
    """DDIM steps of the action head."""
    head_steps: int | None = None
    """DDIM steps from the last chunk, moved to now (dual rate, toge); by default every solve has
    all steps, from noise."""
    allow_untrained: bool = False
    """Fly TOGE with seeded random weights: for timing and bring-up only."""
    image_size: int | None = None
    """Pixels a side into the encoder; by default what the policy's contract says (224)."""
    engine: Engine = "auto"
    """What runs the network; auto takes the fastest that computes what torch computes."""
    device: str = "cpu"
    """torch device: cpu, cuda, cuda:1, mps."""
    vision_device: str | None = None
    """Device of the image encoder, if it is another one."""
    action_device: str | None = None
    """Device of the action head, if it is another one."""
    seed: int = 0
    """Seed of random weights and of the flight's initial diffusion noise; evaluate: of courses and
    delays, too."""

    def __post_init__(self) -> None:
        """Refuse what the scheduler and encoders cannot serve."""
        _check("num-diffusion-steps", self.num_diffusion_steps, 1, 100, "steps")
        if self.head_steps is not None:
            _check("head-steps", self.head_steps, 1, self.num_diffusion_steps, "steps")
        if self.image_size is not None:
            _check("image-size", self.image_size, 32, 1024, "pixels")
        _check("seed", self.seed, 0, 2**63 - 1, "")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """Where the images come from."""

    camera: str = "0"
    """Device index or /dev/videoN, rtsp:// udp:// http:// URL, video file, shm:NAME,
    screen:WINDOW TITLE."""
    window_name: str | None = None
    """Same as --camera "screen:WINDOW TITLE"."""

    @property
    def source(self) -> str:
        """The one camera spec that both flags end in."""
        return self.camera if self.window_name is None else f"screen:{self.window_name}"


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class FlyConfig:
    """One flight."""

    link: LinkConfig = field(default_factory=LinkConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    rates: Rates = field(default_factory=Rates)
    limits: Limits = field(default_factory=Limits)
    mode: str | None = None
    """Flight mode to ask for before flying, e.g. ALT_HOLD; by default the mode is left alone."""
    arm: bool = False
    """Arm the vehicle when everything is ready; by default arming is left to the pilot."""
    duration: float | None = None
    """Seconds to fly once engaged; by default until Ctrl-C."""
    rerun: Annotated[str, Parameter(help="spawn, connect[=URL], FILE.rrd, or off.")] = "off"
    record: Path | None = None
    """Record the flight into this folder, new or empty: camera, ticks, raw MAVLink; needs the extra
    "record"."""
    report: Path | None = None
    """Write the timing report here as JSON."""

    def __post_init__(self) -> None:
        """Refuse contradictions."""
        if self.duration is not None:
            _check("duration", self.duration, 0.1, 86400, "s")
        if self.link.readonly and (self.arm or self.mode is not None):
            raise UserError("--readonly sends nothing, so it cannot be used with --arm or --mode")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """One LeRobot dataset made of flights."""

    out: Path
    """Folder for the dataset, new or empty."""
    task: str = "fly"
    """What the flights do, in words, for policies that read them."""

    def __post_init__(self) -> None:
        """Refuse a task that says nothing."""
        if not self.task.strip():
            raise UserError("--task must say something")


CHECK_COURSE_SEED = 900_000
"""Course seeds from here on are flown during training, and neither learned from nor evaluated."""
HELD_OUT_COURSE_SEED = 1_000_000
"""Course seeds from here on are for evaluation: nothing is ever trained on them."""
MAX_EPISODES = 10_000
"""Of one evaluation, so that another seed has other courses."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """One training run."""

    out: Path | None = None
    """Checkpoint to write (.safetensors); an unfinished run is kept beside it."""
    policy: str = "toge"
    """toge[:small|medium|large][:BACKBONE], resnet-unet[:SIZE], or world-model."""
    image_size: int | None = None
    """Pixels a side into the encoder; 224, or 64 for a world model, if not given."""
    minutes: float | None = None
    """How long to train; 45 if neither this nor --steps is given."""
    steps: int | None = None
    """How many optimiser steps to train, in place of --minutes."""
    batch_size: int | None = None
    """Images a step while the encoder learns; 32, or 8 for a world model, if not given."""
    seed: int = 0
    """Of weights, order and noise."""
    device: str = "cpu"
    """torch device: cpu, cuda, cuda:1."""
    resume: bool = False
    """Go on with the unfinished run of --out."""
    validation_fraction: float = 0.1
    """Share of the flights that are held out."""
    ages: str | None = None
    """Image ages to train for: the flight folder that they were measured in, or LOW:HIGH in ms; by
    default those measured in the flights."""
    camera_key: str | None = None
    """Camera of a LeRobot dataset that has several, e.g. observation.images.front."""
    start_from: Path | None = None
    """Checkpoint to go on from, e.g. after more flights were added. Of a world model only the
    autoencoder can be kept: give --freeze-encoder too."""
    freeze_encoder: bool = False
    """Train the head alone, on what the encoder of --start-from makes of the images; for a world
    model, the dynamics alone and anew."""
    backbone_weights: Path | None = None
    """torchvision's ImageNet weights of the encoder (.pth)."""
    pack: bool = False
    """Write a checkpoint to ship, a third of the size: the encoder in int8, the rest in float16."""
    check_flights: int = 0
    """Courses to fly with the weights now and then; the best in flight are kept, not those with the
    least loss. Takes the extra "sitl"."""
    mirror: bool = True
    """Mirror half of the samples; --no-mirror for a camera that does not look straight ahead."""
    since_exposure: bool = True
    """Tell the policy its image's age and how it moved since; --no-since-exposure to leave out."""
    gate_weight: float = 100.0
    """Weight of the loss that asks the encoder for the gates, in flights that know; 0 = off."""

    def __post_init__(self) -> None:
        """Refuse values that no run could use."""
        if self.minutes is not None and self.steps is not None:
            raise UserError("--minutes and --steps contradict each other: give one of them")
        if self.image_size is not None:
            _check("image-size", self.image_size, 32, 1024, "pixels")
        if self.batch_size is not None:
            _check("batch-size", self.batch_size, 2, 4096, "")
        _check("seed", self.seed, 0, 2**63 - 1, "")
        _check("validation-fraction", self.validation_fraction, 0, 0.9, "")
        _check("gate-weight", self.gate_weight, 0, 10_000, "")
        _check("check-flights", self.check_flights, 0, MAX_EPISODES, "")
        if self.minutes is not None:
            _check("minutes", self.minutes, 0.01, 100_000, "minutes")
        if self.steps is not None:
            _check("steps", self.steps, 1, 10**9, "steps")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """One benchmark run."""

    quick: bool = False
    """A minute or two instead of nearly ten: figures to look at, not to quote."""
    json: Path | None = None
    """Write all figures here as JSON."""
    plot: Path | None = None
    """Draw the figures here as PNG; needs matplotlib (the extra "bench")."""
    check: Path | None = None
    """Compare with this budget of ratios, and exit with 1 if something got worse."""


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
        _check("start-at", self.start_at, 0, 86400, "s")
        _check("n-iter", self.n_iter, 1, 1_000_000, "")
        _check("frames", self.frames, 1, 256, "")
        _check("exe-steps", self.exe_steps, 1, 256, "")
        _check("ddim-steps", self.ddim_steps, 1, 1000, "")


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
        _check("ddim-steps", self.ddim_steps, 1, 1000, "")
        _check("windows", self.windows, 1, 10_000, "")
        _check("chains", self.chains, 1, 10_000, "")
        if self.exe_steps is not None:
            _check("exe-steps", self.exe_steps, 1, 256, "")
        _check("fov", self.fov, 10, 170, "degrees")
        _check("camera-tilt", self.camera_tilt, -90, 90, "degrees")
        _check("yaw-rate", self.yaw_rate, 1, 2000, "degrees/s")
        _check("seed", self.seed, 0, 2**63 - 1, "")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RolloutBenchConfig:
    """One benchmark of rollouts."""

    quick: bool = False
    """Short runs: figures to look at, not to quote."""
    json: Path | None = None
    """Write all figures here as JSON."""
    plot: Path | None = None
    """Draw the figures here as PNG; needs matplotlib (the extra "bench")."""
    world_model: Path | None = None
    """Weights of the world model; by default those that come with mavbridge, or else random
    ones, which take as long."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DemonstrateConfig:
    """Flights to learn from."""

    out: Path
    """Folder for the flights, each in a folder of its own; what is there already is kept."""
    episodes: int = 100
    """Flights in all."""
    speed: float = 5.0
    """Of the expert along the course, in m/s."""
    max_time: float = 40.0
    """Seconds after which a flight ends, on the course or not; a short one can start a rollout."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """With --checkpoint the policy flies most of the time, and the expert says what it would do
    (DAgger)."""
    workers: int = 1
    """Flights at a time."""

    def __post_init__(self) -> None:
        """Refuse what cannot be flown."""
        _check("episodes", self.episodes, 1, MAX_EPISODES, "")
        _check("speed", self.speed, 1.5, 10, "m/s")
        _check("max-time", self.max_time, 1, 3600, "s")
        _check("workers", self.workers, 1, 64, "")
        _check("seed", self.policy.seed, 0, CHECK_COURSE_SEED // MAX_EPISODES - 1, "")

    @property
    def first_course_seed(self) -> int:
        """Never one of those that train or evaluate flies."""
        return self.policy.seed * MAX_EPISODES


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
        _check("episodes", self.episodes, 1, MAX_EPISODES, "")
        _check("max-time", self.max_time, 1, 3600, "s")
        _check("workers", self.workers, 1, 10_000, "")
        _check("vision-delay", self.vision_delay, 0, 5000, "ms")
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
