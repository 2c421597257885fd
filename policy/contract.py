"""A policy's inputs and outputs: names, order, frames, shapes, times.

Imports no torch. A checkpoint carries its ``Contract`` in the header, and mavbridge rejects a
contract that it cannot keep.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from itertools import chain
from typing import Annotated, Any, Literal, TypeAlias, get_origin

import numpy as np
from numpy.typing import NDArray

from policy.errors import ContractError
from policy.fields import Between, field_kinds, require_fields
from policy.files import parse_object

CONTRACT_VERSION, OLDEST_VERSION = 6, 4
"""Version of contracts that are written, and the oldest version that can be read."""
NS_PER_S = 1_000_000_000

STATE_NAMES = (
    *("vx_mps", "vy_mps", "vz_mps"),
    *("qw", "qx", "qy", "qz"),
    *("wx_radps", "wy_radps", "wz_radps"),
    *("ax_mps2", "ay_mps2", "az_mps2"),
)
"""World velocity, world_from_body quaternion (unit, qw >= 0), body rates, body specific force."""
STATE_DIM = len(STATE_NAMES)
VELOCITY, QUATERNION, RATE, SPECIFIC_FORCE = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)

SINCE_EXPOSURE_NAMES = (
    "age_s",
    *("rotation_x_rad", "rotation_y_rad", "rotation_z_rad"),
    *("velocity_change_x_mps", "velocity_change_y_mps", "velocity_change_z_mps"),
)
"""Motion from the image's exposure to the state, appended to the state if a contract asks for it.

Elapsed time, slightly negative if the image is newer than the attitude; rotation vector of the
body; change of its velocity. Both vectors are in body axes at the exposure.
"""
SINCE_EXPOSURE_DIM = len(SINCE_EXPOSURE_NAMES)
StateExtra = Literal["goal", "height", "altitude"]
EXTRA_NAMES: dict[StateExtra, tuple[str, ...]] = {
    "goal": ("goal_x_m", "goal_y_m", "goal_z_m"),
    "height": ("height_above_home_m",),
    "altitude": ("altitude_m",),
}
"""Optional inputs appended to the state: vector from the vehicle to the flight's goal, in the world
axes of ``Contract.state_frame``; height above the home position; height above the estimator's
origin. Heights are positive upwards in both frames."""
AGE, ROTATION, VELOCITY_CHANGE = slice(13, 14), slice(14, 17), slice(17, 20)

ACTION_NAMES = ("throttle", "yaw", "pitch", "roll")
"""Sticks in [-1, 1]: up, nose right, stick forward (nose down), right; 0 = centred."""
ACTION_DIM = 4
ActionKind = Literal["sticks", "rates", "attitude", "velocity"]
"""Meaning of the four numbers of an action.

- sticks: ``ACTION_NAMES``.
- rates: collective thrust in [0, 1]; roll, pitch, yaw rate in rad/s about the body's axes.
- attitude: collective thrust in [0, 1]; roll and pitch in rad; yaw rate in rad/s.
- velocity: x, y, z in m/s; yaw rate in rad/s.

Axes and signs of rates, attitude and velocity follow ``Contract.state_frame``: in ned_frd a
positive pitch is nose up and a positive yaw rate nose right, in enu_flu nose down and nose left.
"""
VelocityFrame = Literal["world", "heading"]
"""Frame of velocity actions: world axes, or level axes that turn with the nose."""

IMAGENET_MEAN_RGB = (0.485, 0.456, 0.406)
IMAGENET_STD_RGB = (0.229, 0.224, 0.225)

FloatArray = NDArray[np.float32]
CameraImage = NDArray[np.uint8 | np.uint16]
"""[H, W, 3] uint8 in RGB, or a depth image [H, W] uint16."""
ImageFit = Literal["stretch", "crop", "pad"]
"""Fit of a camera image: change the proportions, crop longer sides evenly, or add black bars."""
ImageChannels = Literal["rgb", "bgr", "depth"]
StateFrame = Literal["ned_frd", "enu_flu"]
StateTime = Literal["measured", "execution"]
Arrays = Literal["numpy", "torch"]
STICK_MODES = (
    *("STABILIZE", "ACRO", "ALT_HOLD", "LOITER", "POSHOLD", "SPORT", "DRIFT"),
    *("MANUAL", "STABILIZED", "ALTCTL", "POSCTL"),
)
"""Autopilot modes for stick actions: ArduPilot's copter modes, then PX4's; ACRO exists in both."""
ATTITUDE_MODES = ("GUIDED_NOGPS", "GUIDED", "OFFBOARD")
"""Autopilot modes that follow an attitude or body rates; the first needs no position."""
ACTION_MODES: dict[ActionKind, tuple[str, ...]] = {
    "sticks": STICK_MODES,
    "rates": ATTITUDE_MODES,
    "attitude": ATTITUDE_MODES,
    "velocity": ("GUIDED", "OFFBOARD"),
}
LEAST = 1e-3
"""Least time in seconds, and least value of any other quantity that is a divisor."""
MOST_PIXEL = 10.0
"""Largest mean and standard deviation of an image; its pixels are in [0, 1]."""
ENVELOPE_TERMS = ("max_tilt_deg", "max_speed_mps", "max_height_m", "max_distance_m")
_CHUNK_AGES = ("max_state_age_s", "max_velocity_age_s", "max_feature_age_s", "max_chunk_age_s")
LIMIT_TERMS = (*_CHUNK_AGES, "max_stall_s", *ENVELOPE_TERMS)
FLIGHT_TERMS = ("action", "modes", "play_s", "state_time", "stops_at_end", *LIMIT_TERMS)
"""Fields that decide how a policy is flown and do not affect its network's output."""
STICK_TERMS = (
    *("modes", "full_lean_deg", "full_yaw_rate_degps", "full_climb_mps", "full_descent_mps"),
    *("lean_dead_zone", "yaw_dead_zone", "throttle_dead_zone"),
)
"""Fields that decide what a stick does; recorded sticks mean nothing without them."""
Interval: TypeAlias = Annotated[float, Between(LEAST, 1.0, "seconds")]
Age: TypeAlias = Annotated[float, Between(LEAST, 60.0, "seconds")]


@dataclass(frozen=True, kw_only=True)
class Contract:
    """Interface of one policy, and the terms under which it may fly.

    Times are seconds, never ticks: one checkpoint behaves the same at 50, 100 or 250 Hz. Ages are
    judged when a command leaves for the autopilot, not when its computation starts. A flight's
    configuration may tighten their limits, never loosen them.
    """

    state_frame: StateFrame = "ned_frd"
    """World and body axes of the state: MAVLink's NED/FRD or ROS's ENU/FLU."""
    image_height: Annotated[int, Between(16, 4096)] = 224
    image_width: Annotated[int, Between(16, 4096)] = 224
    image_mean_rgb: tuple[float, float, float] = IMAGENET_MEAN_RGB
    image_std_rgb: tuple[float, float, float] = IMAGENET_STD_RGB
    image_crop: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    """Part of the camera image to use: top, left, bottom, right, as shares of its height and width.
    It is cut out before the image is resized."""
    image_fit: ImageFit = "stretch"
    image_channels: ImageChannels = "rgb"
    """Order of the three channels. Mean and deviation are in the order red, green, blue in any
    case. With "depth" there is one channel, float32: the distance along the optical axis in metres,
    neither scaled nor shifted, 0 if unknown. It needs a depth camera."""
    depth_unit_m: Annotated[float, Between(1e-6, 1.0, "m")] = 0.001
    """Metres per step of a depth camera's 16-bit pixels; 0.001 means millimetres."""
    cameras: tuple[str, ...] = ("front",)
    """Names of the cameras, in the order of their features; all images have one size."""
    camera_rates_hz: tuple[float, ...] = ()
    """Highest image rate of each camera; empty: the flight's visual rate for all."""
    feature_dim: Annotated[int, Between(0, 1 << 20)] = 0  # the cells of an ACT are 153,600
    """F of encode_visual's [B, F], for one camera; 0 without a fast path."""
    observation_steps: Annotated[int, Between(1, 16)] = 1
    """Number T of states, and of images of each camera, in one input; oldest first."""
    observation_dt_s: Interval = 0.1
    """Time between observations."""
    horizon: Annotated[int, Between(1, 1024)] = 16
    chunk_dt_s: Interval = 0.05
    """Time between the actions of a chunk; action 0 acts at the time of the state."""
    history_len: Annotated[int, Between(1, 1024)] = 4
    """Number K of past actions, as sent, oldest first."""
    history_dt_s: Interval = 0.05
    """Time between past actions; the newest is history_dt_s before the state."""
    prefix_len: Annotated[int, Between(0, 1024)] = 0
    """Number P of rows behind the past actions in the action history: the committed actions, which
    the vehicle flies before the next chunk can take over. Row p acts ``p * chunk_dt_s`` after the
    state, as row p of that chunk. Rows beyond the expected takeover are NaN."""
    arrays: Arrays = "torch"
    state_time: StateTime = "measured"
    """Time of the newest state. "execution": predicted to the moment at which the chunk will act,
    from the actions flown until then; for policies that take long."""
    since_exposure: bool = False
    """True: append ``SINCE_EXPOSURE_NAMES`` to the state."""
    state_extras: tuple[StateExtra, ...] = ()
    """Further inputs appended to the state, in this order; see ``EXTRA_NAMES``."""
    play_s: float = 0.0
    """Longest time for which the policy was designed to play one chunk before the next; the four
    age limits count from the chunk's beginning. 0: a new chunk from every new state."""
    stops_at_end: bool = False
    """True: the policy stops where its task ends. Once it has stood still for 1.5 s, the flight
    ends and the autopilot holds the place, which a policy without memory cannot."""
    action: ActionKind = "sticks"
    velocity_frame: VelocityFrame = "world"
    hover_thrust: Annotated[float, Between(LEAST, 1.0, "of full thrust")] = 0.39
    """Hover thrust in training; a vehicle with another hover thrust gets all thrust in proportion.
    For rates and attitude. 0.39 is the bundled simulator's."""
    full_lean_deg: Annotated[float, Between(LEAST, 80.0, "degrees")] = 30.0
    """Roll and pitch at full stick, in training; linear outside the dead zone. This and the six
    stick fields below it apply to sticks in modes that hold the height; the defaults are
    ArduCopter's."""
    full_yaw_rate_degps: Annotated[float, Between(LEAST, 2000.0, "degrees/s")] = 202.5
    full_climb_mps: Annotated[float, Between(LEAST, 100.0, "m/s")] = 2.5
    full_descent_mps: Annotated[float, Between(LEAST, 100.0, "m/s")] = 2.5
    lean_dead_zone: float = 0.04
    """Dead zone of the stick in training, as a share of the travel to each side of the centre."""
    yaw_dead_zone: float = 0.04
    throttle_dead_zone: float = 0.2
    modes: tuple[str, ...] = ()
    """Autopilot modes in which the policy may fly, best first: equal sticks mean a lean angle in
    one mode and a body rate in another. Empty: the usual modes of ``action``."""
    max_state_age_s: Age = 0.1
    """Maximum age of the attitude and body rates behind a command."""
    max_velocity_age_s: Age = 0.25
    """Maximum age of the velocity and acceleration behind a command."""
    max_feature_age_s: Age = 0.3
    """Maximum age of the image behind a command, since its exposure."""
    max_chunk_age_s: Age = 0.3
    """Maximum time since the chunk was computed."""
    max_stall_s: Age = 0.25
    """Longest time to fly on along a chunk while no newer one arrives; never beyond its horizon.
    The ages of a chunk are judged when it is accepted, and grow during the stall."""
    max_tilt_deg: Annotated[float | None, Between(LEAST, 180.0, "degrees")] = None
    """Lean that the policy needs. This and the three limits below only widen the default envelope
    of a flight (60 degrees); None or a smaller number leaves it. The setting envelope.tilt has the
    last word."""
    max_speed_mps: Annotated[float | None, Between(LEAST, 1e3, "m/s")] = None
    max_height_m: Annotated[float | None, Between(LEAST, 1e5, "m")] = None
    """Height above the estimator's origin, where the vehicle was switched on."""
    max_distance_m: Annotated[float | None, Between(LEAST, 1e6, "m")] = None
    """Horizontal distance from the estimator's origin."""
    version: int = field(default=CONTRACT_VERSION, init=False)

    def __post_init__(self) -> None:
        try:
            for name in _LISTS:
                if isinstance(value := getattr(self, name), list):
                    object.__setattr__(self, name, tuple(value))
            if self.modes == () and self.action in ACTION_MODES:
                usual = ("ALT_HOLD", "ALTCTL") if self.action == "sticks" else None
                object.__setattr__(self, "modes", usual or ACTION_MODES[self.action])
            require_fields(self, ContractError)
            for name, is_right, wanted in chain(self._checked_values(), self._checked_lists()):
                if not is_right:
                    raise ContractError(f"{name} must be {wanted}, got {getattr(self, name)!r}")
        except (TypeError, ValueError, OverflowError, AttributeError) as error:
            raise ContractError(f"malformed contract: {error}") from error

    def _checked_values(self) -> Iterator[tuple[str, bool, str]]:
        """Yield name, True if it is right, and what it must be, of a field with another rule."""
        for name in ("lean_dead_zone", "yaw_dead_zone", "throttle_dead_zone"):
            share = getattr(self, name)
            yield name, Between(0, 0.9).holds(share) and share < 0.9, "in [0, 0.9) of the travel"
        longest_s = self.horizon * self.chunk_dt_s
        is_play = Between(0, longest_s).holds(self.play_s) and not 0 < self.play_s < LEAST
        yield "play_s", is_play, f"0, or {LEAST:g} to at most the {longest_s:g} s of a chunk"
        is_prefix = self.prefix_len == 0 or self.state_time == "measured"
        wanted = f"less than horizon {self.horizon}, and 0 if state_time is 'execution'"
        yield "prefix_len", is_prefix and self.prefix_len < self.horizon, wanted

    def _checked_lists(self) -> Iterator[tuple[str, bool, str]]:
        """Yield as ``_checked_values`` for fields of several values."""
        for name, low, usual in (
            ("image_mean_rgb", -MOST_PIXEL, IMAGENET_MEAN_RGB),
            ("image_std_rgb", 1e-6, IMAGENET_STD_RGB),
        ):
            rgb = getattr(self, name)
            is_right = len(rgb) == 3 and all(Between(low, MOST_PIXEL).holds(value) for value in rgb)
            yield name, is_right, f"3 numbers in [{low:g}, {MOST_PIXEL:g}], for pixels in [0, 1]"
            is_free = not self.is_depth or rgb == usual
            yield name, is_free, "left out: image_channels 'depth' gives metres as they are"
        crop, names, extras = self.image_crop, self.cameras, self.state_extras
        is_crop = len(crop) == 4 and all(Between(0, 1).holds(share) for share in crop)
        is_crop = is_crop and min(crop[2] - crop[0], crop[3] - crop[1]) >= LEAST
        wanted = f"top, left, bottom, right within [0, 1], at least {LEAST:g} apart"
        yield "image_crop", is_crop, wanted
        are_names = len(names) > 0 and len(set(names)) == len(names)
        are_names = are_names and all(map(str.isidentifier, names))
        yield "cameras", are_names, "one or more different names"
        are_rates = all(Between(0.01, 240).holds(hz) for hz in self.camera_rates_hz)
        are_rates = are_rates and len(self.camera_rates_hz) in (0, len(names))
        wanted = f"a rate in [0.01, 240] Hz for each of {names}"
        yield "camera_rates_hz", are_rates, wanted
        are_extras = len(set(extras)) == len(extras) and set(extras) <= set(EXTRA_NAMES)
        yield "state_extras", are_extras, f"some of {', '.join(EXTRA_NAMES)}, each once"
        known = ACTION_MODES[self.action]
        are_modes = len(self.modes) > 0 and set(self.modes) <= set(known)
        yield "modes", are_modes, f"one or more of {', '.join(known)} for action {self.action!r}"

    @property
    def state_names(self) -> tuple[str, ...]:
        """Numbers of the state that the policy takes, in order."""
        extras = [name for extra in self.state_extras for name in EXTRA_NAMES[extra]]
        return STATE_NAMES + (SINCE_EXPOSURE_NAMES if self.since_exposure else ()) + (*extras,)

    @property
    def state_dim(self) -> int:
        """Width of the policy's state: 13, or 20 with ``since_exposure``, plus the extras."""
        return len(self.state_names)

    @property
    def state_shape(self) -> tuple[int, ...]:
        """Shape of the state without the batch: [S], or [T, S] with several observations."""
        return self._stacked(self.state_dim)

    @property
    def feature_shape(self) -> tuple[int, ...]:
        """Shape of the feature argument of ``predict_fast``, without the batch: [F] or [T, F].

        F spans the concatenated features of all cameras.
        """
        return self._stacked(self.feature_dim * len(self.cameras))

    @property
    def history_shape(self) -> tuple[int, int]:
        """Shape [K + P, 4] of the action history, without the batch."""
        return self.history_len + self.prefix_len, ACTION_DIM

    @property
    def is_depth(self) -> bool:
        """True if the policy takes depth images."""
        return self.image_channels == "depth"

    @property
    def picture_shape(self) -> tuple[int, ...]:
        """Shape of a fitted camera image: [H, W, 3], or [H, W] for depth."""
        return (self.image_height, self.image_width, *(() if self.is_depth else (3,)))

    @property
    def image_shape(self) -> tuple[int, ...]:
        """Shape of the image argument of ``predict``, without the batch.

        [3, H, W], or [N, 3, H, W] with several cameras; several observations add a leading T; depth
        has 1 channel.
        """
        each = (1 if self.is_depth else 3, self.image_height, self.image_width)
        return self._stacked(*(each if len(self.cameras) == 1 else (len(self.cameras), *each)))

    def _stacked(self, *shape: int) -> tuple[int, ...]:
        return shape if self.observation_steps == 1 else (self.observation_steps, *shape)

    def to_json(self) -> str:
        """Return the form that is stored in a checkpoint's header."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> "Contract":
        """Read the header form; fields that an older version lacks get their defaults."""
        data = parse_object(text, ContractError, "the contract")
        version = data.pop("version", CONTRACT_VERSION)
        if not isinstance(version, int) or not OLDEST_VERSION <= version <= CONTRACT_VERSION:
            raise ContractError(
                f"contract version {version!r} is not supported; this build reads versions "
                f"{OLDEST_VERSION} to {CONTRACT_VERSION}: export it again, or update mavbridge"
            )
        return cls.from_fields(data)

    @classmethod
    def from_fields(cls, data: Mapping[str, Any]) -> "Contract":
        """Return the contract with these fields; raise ContractError for unknown ones."""
        known = {each.name for each in fields(cls) if each.init}
        if unknown := sorted(set(data) - known):
            raise ContractError(f"unknown contract keys {unknown}; there are {sorted(known)}")
        return cls(**data)


_LISTS = [name for name, (kind, _) in field_kinds(Contract).items() if get_origin(kind) is tuple]


def history_ages_ns(length: int, dt_s: float) -> Sequence[int]:
    """Return the ages at the tick of a history's actions, oldest first; the newest is ``dt_s`` old.

    An action holds until the next one is sent, so the action at a time is the newest one sent by
    then. After a release, and before the first action, it is neutral.
    """
    dt_ns = round(dt_s * NS_PER_S)
    return range(length * dt_ns, 0, -dt_ns)
