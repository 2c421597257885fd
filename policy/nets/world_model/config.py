"""Dimensions of a world model, and its assumptions about the camera."""

import math
from dataclasses import dataclass, field

from policy.contract import Contract
from policy.errors import PolicyError
from policy.nets.diffusion import NoiseSchedule

FACTOR = 8
"""Pixels along a side of one latent."""
HEAD_DIM = 32
"""Width of one attention head."""


@dataclass(frozen=True, kw_only=True)
class WorldModelConfig:
    """Dimensions and camera of a world model."""

    image_size: int = 64
    """Side of the square frames, px."""
    latent_channels: int = 8
    frames: int = 16
    """Frames, states and actions in one imagined future."""
    context_frames: int = 2
    """Past frames and states; the newest is the current one."""
    frame_dt_s: float = 0.1
    """Time between two frames. Action k is the mean stick from frame k - 1 (the last of the context
    for k = 0) to frame k; state k is at the exposure of frame k."""
    horizontal_fov_rad: float = math.radians(90.0)
    """Field of view of the camera, a forward-looking pinhole without distortion."""
    camera_tilt_rad: float = math.radians(10.0)
    """Upward tilt of the camera. Both defaults are those of the simulator's nominal camera."""
    autoencoder_widths: tuple[int, int, int] = (24, 40, 56)
    patch: int = 2
    """Latents along a side of one token."""
    dynamics_width: int = 128
    dynamics_depth: int = 5
    contract: Contract = field(default_factory=Contract)
    """Its ``state_frame`` is that of the states. The other fields concern policies; ``image_size``
    and ``frame_dt_s`` of the model are separate."""
    schedule: NoiseSchedule = field(default_factory=NoiseSchedule)

    def __post_init__(self) -> None:
        object.__setattr__(self, "autoencoder_widths", tuple(self.autoencoder_widths))  # a list
        if self.image_size < FACTOR or self.image_size % (FACTOR * self.patch):
            raise PolicyError(
                f"image_size must be a multiple of {FACTOR * self.patch} ({FACTOR} pixels a "
                f"latent, {self.patch} latents a token), got {self.image_size}"
            )
        if self.schedule.prediction != "sample":
            raise PolicyError("the schedule of a world model must predict the sample")

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """Channels, height and width of one frame's latents."""
        side = self.image_size // FACTOR
        return self.latent_channels, side, side
