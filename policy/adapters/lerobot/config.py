"""What config.json of a LeRobot policy says, as far as inference depends on it.

LeRobot writes every entry that its version knows, so an entry is missing only where a version did
not have it yet. Those have the one value that this version computed with; all others must be there,
because the defaults of LeRobot's own code changed with 0.6.0.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from policy import files
from policy.contract import ACTION_DIM, EXTRA_NAMES
from policy.errors import CheckpointError

CONFIG_FILE = "config.json"
STATE_KEY, ACTION_KEY = "observation.state", "action"
ENVIRONMENT_KEY = "observation.environment_state"
"""LeRobot's input for what is known of the world; here the goal of the flight."""
NO_IMAGE_PX = 16
"""Side of the blank image of a policy without a camera: the smallest of a contract."""
BACKBONES = ("resnet18", "resnet34", "resnet50", "resnet101", "resnet152")
MODES = ("IDENTITY", "MEAN_STD", "MIN_MAX", "QUANTILES", "QUANTILE10")
_WITHOUT_EFFECT = {
    *("type", "device", "use_amp", "use_peft", "push_to_hub", "repo_id", "private", "tags"),
    *("license", "pretrained_path", "pretrained_revision", "pretrained_backbone_weights"),
    *("input_features", "output_features", "normalization_mapping", "n_obs_steps"),
    *("n_action_steps", "drop_n_last_frames", "crop_is_random", "compile_model", "compile_mode"),
    *("gradient_checkpointing", "use_vae", "latent_dim", "n_vae_encoder_layers", "dropout"),
    *("kl_weight", "do_mask_loss_for_padding", "optimizer_lr", "optimizer_weight_decay"),
    *("optimizer_lr_backbone", "optimizer_betas", "optimizer_eps"),
    *("scheduler_name", "scheduler_warmup_steps"),
}
"""Entries that only training looks at, or that are read apart from the network's own."""


@dataclass(frozen=True, kw_only=True)
class Features:
    """What a policy takes and gives, by LeRobot's names."""

    image_keys: tuple[str, ...]
    """Its cameras, in the order of their features; empty for a policy that looks at no image."""
    image_height: int
    image_width: int
    state_dim: int | None
    """Width of observation.state; None where it takes none."""
    takes_goal: bool
    """observation.environment_state is the vector to the goal, ``policy.contract.EXTRA_NAMES``."""
    modes: Mapping[str, str]
    """Normalisation of STATE, VISUAL and ACTION: one of ``MODES``."""


@dataclass(frozen=True, kw_only=True)
class ActConfig:
    """An Action Chunking Transformer (Zhao et al. 2023)."""

    features: Features
    vision_backbone: str
    chunk_size: int
    dim_model: int
    n_heads: int
    dim_feedforward: int
    feedforward_activation: Literal["relu", "gelu"]
    n_encoder_layers: int
    n_decoder_layers: int
    pre_norm: bool
    latent_dim: int
    temporal_ensemble_coeff: float | None

    @property
    def n_obs_steps(self) -> int:
        """Observations that it takes: one."""
        return 1

    @property
    def horizon(self) -> int:
        """Actions from now on."""
        return self.chunk_size

    @property
    def feature_dim(self) -> int:
        """The cells of one image's last map, each projected to the transformer's width."""
        height, width = map_size(self.features.image_height, self.features.image_width)
        return self.dim_model * height * width


@dataclass(frozen=True, kw_only=True)
class DiffusionConfig:
    """A diffusion policy (Chi et al. 2023) with a 1-D U-Net."""

    features: Features
    vision_backbone: str
    n_obs_steps: int
    predicted: int
    """Actions of a chunk; the first of them acts at the oldest observation."""
    resize_shape: tuple[int, int] | None
    crop_shape: tuple[int, int] | None
    use_group_norm: bool
    spatial_softmax_num_keypoints: int
    use_separate_rgb_encoder_per_camera: bool
    down_dims: tuple[int, ...]
    kernel_size: int
    n_groups: int
    diffusion_step_embed_dim: int
    use_film_scale_modulation: bool
    noise_scheduler_type: str
    num_inference_steps: int
    num_train_timesteps: int
    beta_schedule: str
    beta_start: float
    beta_end: float
    prediction_type: Literal["epsilon", "sample"]
    clip_sample: bool
    clip_sample_range: float

    @property
    def horizon(self) -> int:
        """Actions from now on: those before the newest observation are past."""
        return self.predicted - self.n_obs_steps + 1

    @property
    def feature_dim(self) -> int:
        """Two coordinates of each keypoint, through one layer; one zero without a camera."""
        return 2 * self.spatial_softmax_num_keypoints if self.features.image_keys else 1

    @property
    def encoded_size(self) -> tuple[int, int]:
        """Height and width of the image that the encoder sees."""
        image = (self.features.image_height, self.features.image_width)
        return self.crop_shape or self.resize_shape or image


Config = ActConfig | DiffusionConfig


def map_size(height: int, width: int) -> tuple[int, int]:
    """Size of a ResNet's last map: its five layers of stride 2 halve it, rounding up."""
    return -(-height // 32), -(-width // 32)


def read_config(folder: Path) -> tuple[Config, list[str]]:
    """The policy that a folder holds, and notes for the user."""
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise CheckpointError(f"{folder}: holds no {CONFIG_FILE}; {_where_to_look(folder)}")
    entries = _Entries(path)
    kind = entries.text("type", ("act", "diffusion"))
    if entries.flag("use_peft", default=False):
        raise CheckpointError(f"{path}: weights of an adapter (use_peft); merge them before")
    features = _features(entries)
    config: Config
    config = _act(entries, features) if kind == "act" else _diffusion(entries, features)
    notes = []
    if unknown := sorted(set(entries.data) - entries.read - _WITHOUT_EFFECT):
        notes.append(
            f"warning: {path} has entries that this build does not know: {', '.join(unknown)}. If "
            "they change what the policy computes, it flies wrongly"
        )
    return config, notes


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object; raises CheckpointError."""
    try:
        data = files.read_json(path)
    except OSError as error:
        raise CheckpointError(f"{path}: {error.strerror}") from error
    except ValueError as error:
        raise CheckpointError(f"{path}: not JSON ({error})") from error
    if not isinstance(data, dict):
        raise CheckpointError(f"{path}: not a JSON object")
    return data


def _where_to_look(folder: Path) -> str:
    for below in ("pretrained_model", "last/pretrained_model", "checkpoints/last/pretrained_model"):
        if (folder / below / CONFIG_FILE).is_file():
            return f"{folder / below} does: name that one"
    return (
        "lerobot:DIR takes the folder that LeRobot's save_pretrained or lerobot-train wrote, "
        "usually .../checkpoints/last/pretrained_model"
    )


def _act(entries: "_Entries", features: Features) -> ActConfig:
    entries.only("n_obs_steps", 1)
    if features.takes_goal or not features.image_keys:
        raise CheckpointError(
            f"{entries.path}: of LeRobot's ACT those with cameras and without {ENVIRONMENT_KEY} "
            "fly from their files; run this one behind --policy ws://HOST:PORT"
        )
    entries.only("replace_final_stride_with_dilation", False)
    return ActConfig(
        features=features,
        vision_backbone=entries.text("vision_backbone", BACKBONES),
        chunk_size=entries.integer("chunk_size"),
        dim_model=entries.integer("dim_model"),
        n_heads=entries.integer("n_heads"),
        dim_feedforward=entries.integer("dim_feedforward"),
        feedforward_activation=entries.text("feedforward_activation", ("relu", "gelu")),
        n_encoder_layers=entries.integer("n_encoder_layers"),
        n_decoder_layers=entries.integer("n_decoder_layers"),
        pre_norm=entries.flag("pre_norm"),
        latent_dim=entries.integer("latent_dim"),
        temporal_ensemble_coeff=entries.number_or_none("temporal_ensemble_coeff"),
    )


def _diffusion(entries: "_Entries", features: Features) -> DiffusionConfig:
    resize, crop = _resize_and_crop(entries, features)
    if features.state_dim is None:
        raise CheckpointError(f"{entries.path}: a diffusion policy takes {STATE_KEY}")
    train_steps = entries.integer("num_train_timesteps")
    config = DiffusionConfig(
        features=features,
        vision_backbone=entries.text("vision_backbone", BACKBONES),
        n_obs_steps=entries.integer("n_obs_steps"),
        predicted=entries.integer("horizon"),
        resize_shape=resize,
        crop_shape=crop,
        use_group_norm=entries.flag("use_group_norm"),
        spatial_softmax_num_keypoints=entries.integer("spatial_softmax_num_keypoints"),
        use_separate_rgb_encoder_per_camera=entries.flag("use_separate_rgb_encoder_per_camera"),
        down_dims=entries.integers("down_dims"),
        kernel_size=entries.integer("kernel_size"),
        n_groups=entries.integer("n_groups"),
        diffusion_step_embed_dim=entries.integer("diffusion_step_embed_dim"),
        use_film_scale_modulation=entries.flag("use_film_scale_modulation"),
        noise_scheduler_type=entries.text("noise_scheduler_type", ("DDPM", "DDIM")),
        num_inference_steps=entries.integer("num_inference_steps", default=train_steps),
        num_train_timesteps=train_steps,
        beta_schedule=entries.text(
            "beta_schedule", ("squaredcos_cap_v2", "linear", "scaled_linear")
        ),
        beta_start=entries.number("beta_start"),
        beta_end=entries.number("beta_end"),
        prediction_type=entries.text("prediction_type", ("epsilon", "sample")),
        clip_sample=entries.flag("clip_sample"),
        clip_sample_range=entries.number("clip_sample_range"),
    )
    if config.predicted % 2 ** len(config.down_dims) or config.horizon < 1:
        raise CheckpointError(
            f"{entries.path}: a horizon of {config.predicted} does not suit "
            f"{len(config.down_dims)} down_dims and {config.n_obs_steps} n_obs_steps"
        )
    return config


def _resize_and_crop(
    entries: "_Entries", features: Features
) -> tuple[tuple[int, int] | None, tuple[int, int] | None]:
    # Both came after 0.4.0; before, nothing was resized.
    resize = entries.size("resize_shape") if "resize_shape" in entries.data else None
    ratio = entries.number("crop_ratio", default=1.0)
    crop = entries.size("crop_shape")
    if resize is not None:  # then LeRobot takes the crop from the ratio, whatever crop_shape says
        crop = None if ratio == 1.0 else (int(resize[0] * ratio), int(resize[1] * ratio))
    before = resize or (features.image_height, features.image_width)
    if not features.image_keys:
        return None, None
    if crop is not None and (crop[0] > before[0] or crop[1] > before[1]):
        raise CheckpointError(f"{entries.path}: cannot crop images of {before} to {crop}")
    return resize, crop


def _features(entries: "_Entries") -> Features:
    """Cameras, state and action.

    LeRobot's ACT and DiffusionPolicy look at no other feature of type STATE than observation.state,
    and at no other of type ENV than observation.environment_state.
    """
    inputs, outputs = entries.table("input_features"), entries.table("output_features")
    kinds = {key: _feature(entries.path, key, value) for key, value in inputs.items()}
    goal = (len(EXTRA_NAMES["goal"]),)
    takes_goal = kinds.pop(ENVIRONMENT_KEY, None) == ("ENV", goal)
    others = [key for key in inputs if key not in kinds and not takes_goal]
    if others := others + [k for k, (kind, _) in kinds.items() if kind not in ("STATE", "VISUAL")]:
        raise CheckpointError(
            f"{entries.path}: takes {others}, which no vehicle measures; supported are images, "
            f"{STATE_KEY}, and {ENVIRONMENT_KEY} of {goal[0]} numbers: {EXTRA_NAMES['goal']}"
        )
    images = {key: shape for key, (kind, shape) in kinds.items() if kind == "VISUAL"}
    shapes = sorted(set(images.values()))
    if not images and takes_goal:
        shapes = [(3, NO_IMAGE_PX, NO_IMAGE_PX)]
    if len(shapes) != 1 or len(shapes[0]) != 3 or shapes[0][0] != 3:
        raise CheckpointError(
            f"{entries.path}: images must be of one shape [3, height, width], got {images}"
        )
    state = kinds.get(STATE_KEY, ("", ()))[1]
    action = _feature(entries.path, ACTION_KEY, outputs.get(ACTION_KEY))[1]
    if action != (ACTION_DIM,):
        raise CheckpointError(
            f"{entries.path}: its action has the shape {list(action)}, but {ACTION_DIM} numbers "
            "fly a multirotor: train it on four (sticks, rates, attitude or velocity)"
        )
    modes = {str(kind): str(mode) for kind, mode in entries.table("normalization_mapping").items()}
    return Features(
        image_keys=tuple(images),
        image_height=shapes[0][1],
        image_width=shapes[0][2],
        state_dim=state[0] if state else None,
        takes_goal=takes_goal,
        modes=modes,
    )


def _feature(path: Path, key: str, value: object) -> tuple[str, tuple[int, ...]]:
    if isinstance(value, dict):
        kind, shape = value.get("type"), value.get("shape")
        if isinstance(shape, list) and all(isinstance(n, int) and n > 0 for n in shape):
            return str(kind), tuple(shape)
    raise CheckpointError(f"{path}: the feature {key} must have a type and a shape, got {value!r}")


class _Entries:
    """The entries of one config.json, each checked where it is read."""

    def __init__(self, path: Path) -> None:
        self.path, self.data = path, read_json(path)
        self.read: set[str] = set()

    def _value(self, name: str, default: object = None, *, or_none: bool = False) -> Any:
        self.read.add(name)
        value = self.data.get(name)
        if value is None:
            value = default
        if value is None and not (or_none and name in self.data):
            raise CheckpointError(
                f"{self.path}: no entry {name!r}, and its default differs between versions of "
                "LeRobot: add what it was trained with, or save the policy again with LeRobot"
            )
        return value

    def _refuse(self, name: str, value: object, wanted: str) -> CheckpointError:
        return CheckpointError(f"{self.path}: {name} must be {wanted}, got {value!r}")

    def only(self, name: str, wanted: object) -> None:
        """Refuse any other value than the one that is supported."""
        if (value := self._value(name)) != wanted:
            raise self._refuse(name, value, f"{wanted!r}, which alone is supported")

    def text(self, name: str, choices: tuple[str, ...]) -> Any:
        """One of ``choices``."""
        if (value := self._value(name)) not in choices:
            raise self._refuse(name, value, f"one of {', '.join(choices)}")
        return value

    def flag(self, name: str, *, default: bool | None = None) -> bool:
        """True or false."""
        value = self._value(name, default)
        if not isinstance(value, bool):
            raise self._refuse(name, value, "true or false")
        return value

    def integer(self, name: str, *, default: int | None = None) -> int:
        """A positive integer."""
        value = self._value(name, default)
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise self._refuse(name, value, "a positive integer")
        return value

    def number(self, name: str, *, default: float | None = None) -> float:
        """A number."""
        value = self._value(name, default)
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise self._refuse(name, value, "a number")
        return float(value)

    def number_or_none(self, name: str) -> float | None:
        """A number, or null."""
        return None if self._value(name, or_none=True) is None else self.number(name)

    def integers(self, name: str) -> tuple[int, ...]:
        """Some positive integers."""
        value = self._value(name)
        if not isinstance(value, list) or not all(isinstance(n, int) and n > 0 for n in value):
            raise self._refuse(name, value, "positive integers")
        return tuple(value)

    def size(self, name: str) -> tuple[int, int] | None:
        """Height and width, or null."""
        if self._value(name, or_none=True) is None:
            return None
        values = self.integers(name)
        if len(values) != 2:
            raise self._refuse(name, list(values), "a height and a width")
        return values[0], values[1]

    def table(self, name: str) -> dict[str, Any]:
        """An object."""
        value = self._value(name)
        if not isinstance(value, dict):
            raise self._refuse(name, value, "an object")
        return value
