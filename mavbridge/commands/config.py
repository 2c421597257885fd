"""Settings of the commands; those that fly episodes are in ``mavbridge.config.episodes``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Group, Parameter

from mavbridge.config.flags import (
    CAMERA,
    OUTPUT,
    POLICY,
    RATES,
    Ranged,
    hidden,
)
from mavbridge.config.flight import CameraConfig, FlyConfig, ListenConfig
from mavbridge.config.policy import Engine, PolicyConfig
from mavbridge.core.errors import UserError
from policy.fields import Between

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
class ExportPolicyConfig:
    """Policy to export, and the folder for its files."""

    out: Path
    """Folder for encoder.onnx, denoiser.onnx and policy.json."""
    policy: str = "toge"
    """toge[:small|medium|large][:BACKBONE]."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class IdentifyConfig:
    """One flight of the doublet; policy and checkpoint are what it is compared with."""

    flight: FlyConfig = field(default_factory=FlyConfig)
    json: Annotated[Path | None, Parameter(group=OUTPUT)] = None
    """Write all figures here as JSON."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ServeConfig(Ranged):
    """One policy, and where it is served."""

    policy: PolicyConfig = field(default_factory=PolicyConfig)
    host: str = "127.0.0.1"
    """Address to listen at; by default this computer's own clients only. 0.0.0.0 is every network
    that it is in: set MAVBRIDGE_API_KEY then, on both sides."""
    port: Annotated[int, Between(1, 65535)] = 8000
    """Port to listen at."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "host", self.host.removeprefix("[").removesuffix("]"))
        if self.policy.dual_rate:
            raise UserError("each request is answered from its own image: leave out --dual-rate")


NO_POLICY = "none"
"""Value of ``--policy`` of a check without a policy."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class CheckConfig(Ranged):
    """The flight to check, by its own flags."""

    flight: FlyConfig = field(default_factory=FlyConfig)
    timing: Annotated[float, Parameter(group=RATES), Between(0.5, 36_000, "s")] = 3.0
    """Seconds for which the policy is run at its rates, on one dummy sample; minutes show whether
    this computer throttles."""
    soak: Annotated[float | None, Parameter(group=RATES), Between(1, 36_000, "s")] = None
    """Seconds to run the policy at the bundled vehicle, which climbs, and measure this computer.
    Needs the extra "sitl"."""
    json: Annotated[Path | None, Parameter(group=OUTPUT, allow_leading_hyphen=True)] = None
    """Write the rows here as JSON; - is standard output, and the table then goes to standard
    error."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.soak is not None and self.flight.policy.policy == NO_POLICY:
            raise UserError("--soak needs a policy")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """Settings of ``mavbridge export``."""

    out: Path
    """Folder to write, new or empty."""
    format: Literal["lerobot", "mcap"] = "lerobot"
    """lerobot, a dataset, or mcap, a file for each flight, for Foxglove and PlotJuggler. mcap takes
    failed flights, too, and ignores the other flags."""
    task: str = "fly"
    """Task in words, for policies that take one."""
    include_failed: Annotated[bool, Parameter(negative="")] = False
    """Also flights that crashed, were cut off, ended by a fault, were marked as bad, or missed
    gates."""
    image_size: int | None = None
    """Height and width of the images, as the policy is to see them; by default as recorded."""
    state: Literal["world", "body"] = "world"
    """Velocity and attitude in world axes, which mavbridge train takes; or velocity and the
    vertical in body axes, the same on every heading, which other networks learn from sooner."""

    def __post_init__(self) -> None:
        size = self.image_size
        if size is not None and (size % 2 or not 16 <= size <= 4096):
            raise UserError(f"--image-size {size}: an even number from 16 to 4096")
        if not self.task.strip() or any("\ud800" <= each <= "\udfff" for each in self.task):
            raise UserError("--task must be words, in UTF-8: describe what the flights do")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ImagineConfig(Ranged):
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
    start_at: Annotated[float, Between(0, 86400, "s")] = 0.0
    """Seconds into the flight, from its first frame with a state."""
    n_iter: Annotated[int, Between(1, 1_000_000)] = 8
    """Iterations: a decision, and a simulation of its consequences."""
    exe_steps: Annotated[int, Between(1, 256)] = 1
    """Steps that are executed before the next decision."""
    frames: Annotated[int | None, Between(1, 256)] = None
    """Imagined frames that a segment of the video holds; by default the executed ones."""
    ddim_steps: Annotated[int, Between(1, 1000)] = 4
    """DDIM steps of the world model."""
    decode_video: bool = True
    """Write a video; without it only the rows are written."""
    fast_policy_no_decode: bool = False
    """Let the world model decide from its latents, without decoding and encoding them again."""

    def __post_init__(self) -> None:
        super().__post_init__()
        ignored = self.policy.given("device", "seed")
        if self.decider == "toge":
            ignored = ["fast_policy_no_decode"] * self.fast_policy_no_decode
        if ignored:
            other = "toge" if self.decider == "world-model" else "world-model"
            names = ", ".join(ignored).replace("_", " ")
            raise UserError(
                f"{names}: not of --decider {self.decider}; add --decider {other}, or leave it out"
            )
        if self.frames is not None and self.exe_steps > self.frames:
            raise UserError(
                f"--exe-steps {self.exe_steps} exceeds --frames {self.frames}: only imagined "
                "frames can be executed"
            )


@Parameter(name="*", group=OUTPUT)
@dataclass(frozen=True, kw_only=True)
class InspectConfig:
    """Output of an inspection besides its tables on the terminal."""

    html: Path | None = None
    """Write one page with the plots, the path, the worst moments and the video in it."""
    json: Path | None = None
    """Write the figures as JSON: a list with an object for each flight."""
    rerun: str = "off"
    """Show the flight in the Rerun viewer: spawn, connect[=URL], FILE.rrd, or off."""
    gates: Path | None = None
    """Draw the gates of this file, that of python -m sitl course --json; a recording by the
    simulator knows its own."""


EPISODES = Group("Episodes", sort_key=1.5)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RecordConfig(Ranged):
    """Recorded flights of a human pilot."""

    out: Annotated[Path, Parameter(group=OUTPUT)]
    """Folder for the flights, each in a folder of its own; more are added to those in it."""
    vehicle: ListenConfig = field(default_factory=ListenConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    camera_size: Annotated[int, Parameter(group=CAMERA), Between(32, 4096, "pixels")] = 224
    """Least side of the image in pixels. A device is asked for it; any size is recorded."""
    visual_rate: Annotated[float, Parameter(group=CAMERA), Between(0.5, 240, "Hz")] = 30.0
    """Most frames a second."""
    rate: Annotated[float, Parameter(group=RATES), Between(20, 250, "Hz")] = 100.0
    """Rows a second of sticks and state, for which the vehicle is asked, too."""
    episode_channel: Annotated[int | None, Parameter(group=EPISODES), Between(5, 18)] = None
    """Radio channel, from 5, whose switch records while it is high; the middle of a switch of three
    positions ends the episode and marks it as bad."""
    on_arm: Annotated[bool, Parameter(group=EPISODES, negative="")] = False
    """Record while the vehicle is armed."""
    episodes: Annotated[int | None, Parameter(group=EPISODES), Between(1, 9999)] = None
    """End after this number of episodes."""
    rerun: Annotated[str, Parameter(group=OUTPUT)] = "off"
    """Rerun viewer: spawn, connect[=URL], FILE.rrd, or off."""
    disk_reserve: Annotated[float, Parameter(group=OUTPUT), Between(0.05, 10_000, "GB")] = 1.0
    """Gigabytes of the disk that stay free."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.camera.sources == ("none",):
            raise UserError("--camera none: there is nothing to learn from without images")
        if len(self.camera.sources) > 1:
            raise UserError("--camera: the images of one camera are recorded, name only that one")
        if self.on_arm and self.episode_channel is not None:
            raise UserError("--on-arm and --episode-channel both say when to record: leave one out")


ReplayFrom = Literal["auto", "chunks", "features", "video"]


@Parameter(name="*", group=OUTPUT)
@dataclass(frozen=True, kw_only=True)
class ReplayConfig(Ranged):
    """Source of a replay, and settings that differ from the flight; none by default."""

    source: Annotated[ReplayFrom, Parameter(name="--from", group=POLICY)] = "auto"
    """chunks: the guard alone, with the recorded chunks and without a policy; features: the policy
    from the recorded features; video: the encoder as well, from the recorded video, which is lossy.
    auto: features, where there are any and the encoder is the same."""
    policy: Annotated[str | None, Parameter(group=POLICY)] = None
    """Another policy, as --policy of a flight."""
    checkpoint: Annotated[Path | None, Parameter(group=POLICY)] = None
    """Other weights."""
    contract: Annotated[Path | None, Parameter(group=POLICY)] = None
    """Contract file of another policy."""
    num_diffusion_steps: Annotated[int | None, Parameter(group=POLICY)] = None
    """Another number of steps of the action head."""
    engine: Annotated[Engine | None, hidden("network.engine")] = None
    """Another engine, such as torch."""
    device: Annotated[str | None, Parameter(group=POLICY)] = None
    """Another torch device."""
    tau: Annotated[float | None, hidden("limits.tau")] = None
    """Another time constant of the low-pass, in seconds."""
    max_slew: Annotated[float | None, hidden("limits.slew")] = None
    """Another limit of stick movement, in full deflections a second."""
    max_feature_age: Annotated[float | None, hidden("limits.feature-age")] = None
    """Another age of the oldest image to act on, in seconds."""
    max_chunk_age: Annotated[float | None, hidden("limits.chunk-age")] = None
    """Another time for which one chunk may be flown, in seconds."""
    tolerance: Annotated[float | None, Between(0, 10)] = None
    """Largest difference of a stick that counts as equal; default: 0, another engine 0.05, video
    0.15, scripted 0.01; none if policy or limits were changed."""
    plot: Path | None = None
    """Draw the sticks, recorded and replayed, into this PNG."""
    json: Path | None = None
    """Write all figures here as JSON."""

    def __post_init__(self) -> None:
        super().__post_init__()
        of_policy = (self.policy, self.checkpoint, self.contract, self.num_diffusion_steps)
        given = (*of_policy, self.engine, self.device)
        if self.source == "chunks" and any(value is not None for value in given):
            raise UserError(
                "--from chunks takes the recorded chunks and asks no policy: leave out the flags "
                "of the policy, or use --from features or video"
            )
