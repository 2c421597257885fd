"""Settings of ``mavbridge record``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import Group, Parameter

from mavbridge.config.checks import check_range
from mavbridge.config.flight import LinkConfig
from mavbridge.config.groups import CAMERA, OUTPUT, RARE, RATES, VEHICLE
from mavbridge.core.errors import UserError

EPISODES = Group("Episodes", sort_key=1.5)


@Parameter(name="*", group=VEHICLE)
@dataclass(frozen=True, kw_only=True)
class ListenConfig:
    """The vehicle that is only listened to."""

    connect: Annotated[str, Parameter(show_default=False)] = ""
    """The vehicle: udp:HOST:PORT (listen), udpout:HOST:PORT, tcp:HOST:PORT, /dev/ttyX,BAUD; or as
    MAVSDK writes it: udpin://0.0.0.0:14540, serial:///dev/ttyACM0:921600."""
    signing_key_file: Annotated[Path | None, Parameter(show_default=False)] = None
    """Sign every packet, and take only signed ones (MAVLink 2): a file with the vehicle's key, 32
    bytes or 64 hexadecimal digits, which only you may read."""
    target_system: Annotated[int, Parameter(group=RARE)] = 0
    """System id of the vehicle; 0 = the only one on the link."""
    connect_timeout: Annotated[float, Parameter(group=RARE)] = 30.0
    """Seconds to wait for the vehicle's first heartbeat."""

    @property
    def link(self) -> LinkConfig:
        """The link of a flight that sends nothing; raises UserError for what it cannot be."""
        return LinkConfig(
            connect=self.connect,
            signing_key_file=self.signing_key_file,
            target_system=self.target_system,
            connect_timeout=self.connect_timeout,
            readonly=True,
        )


@Parameter(name="*", group=CAMERA)
@dataclass(frozen=True, kw_only=True)
class FilmConfig:
    """The camera, whose images are recorded in the size in which they come."""

    camera: str = "0"
    """Device index or /dev/videoN, rtsp:// udp:// http:// URL, video file, shm:NAME,
    screen:WINDOW TITLE, pipe:COMMAND, or jpeg-udp:[HOST:]PORT."""
    camera_size: int = 224
    """Pixels a side that the image must cover; a device is asked for such a mode."""
    camera_timeout: Annotated[float, Parameter(group=RARE)] = 10.0
    """Seconds to wait for the camera's first frame."""
    camera_latency: float = 0.0
    """Milliseconds from exposure to arrival here; not for shm:, whose frames carry their own
    stamps."""
    visual_rate: float = 30.0
    """Most frames a second."""

    def __post_init__(self) -> None:
        """Refuse sizes and times that no camera has."""
        check_range("camera-size", self.camera_size, 32, 4096, "pixels")
        check_range("camera-timeout", self.camera_timeout, 0.1, 3600, "s")
        check_range("camera-latency", self.camera_latency, 0, 2000, "ms")
        check_range("visual-rate", self.visual_rate, 0.5, 240, "Hz")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RecordConfig:
    """Recorded flights of a human pilot."""

    out: Annotated[Path, Parameter(group=OUTPUT)]
    """Folder for the flights, each in a folder of its own; more are added to those in it."""
    vehicle: ListenConfig = field(default_factory=ListenConfig)
    film: FilmConfig = field(default_factory=FilmConfig)
    rate: Annotated[float, Parameter(group=RATES)] = 100.0
    """Rows a second of sticks and state, for which the vehicle is asked, too."""
    episode_channel: Annotated[int | None, Parameter(group=EPISODES)] = None
    """Radio channel, from 5, whose switch records while it is high; the middle of a switch of three
    positions ends the episode and marks it as bad."""
    on_arm: Annotated[bool, Parameter(group=EPISODES, negative="")] = False
    """Record while the vehicle is armed."""
    episodes: Annotated[int | None, Parameter(group=EPISODES)] = None
    """End after so many."""
    rerun: Annotated[str, Parameter(group=OUTPUT)] = "off"
    """Rerun viewer: spawn, connect[=URL], FILE.rrd, or off."""
    disk_reserve: Annotated[float, Parameter(group=OUTPUT)] = 1.0
    """Gigabytes of the disk that stay free: an episode ends when only these are left, and none
    begins with less than a minute of recording before that."""

    def __post_init__(self) -> None:
        """Refuse contradictions, and rates that no autopilot serves."""
        check_range("rate", self.rate, 20, 250, "Hz")
        check_range("disk-reserve", self.disk_reserve, 0.05, 10_000, "GB")
        if self.episode_channel is not None:
            check_range("episode-channel", self.episode_channel, 5, 18, "")
        if self.episodes is not None:
            check_range("episodes", self.episodes, 1, 9999, "")
        if self.on_arm and self.episode_channel is not None:
            raise UserError("--on-arm and --episode-channel both say when to record: leave one out")
