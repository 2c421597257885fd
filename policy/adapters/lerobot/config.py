"""Entries of a LeRobot policy's config.json that inference depends on.

LeRobot writes every entry that its version knows, so an entry is missing only if the version did
not have it yet. Such entries default to the one value that the old version computed with. All
others are required, because the defaults of LeRobot's own code changed with 0.6.0.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from types import NoneType
from typing import Any, ClassVar, Literal, TypeVar, get_args, get_origin, get_type_hints

from policy.contract import ACTION_DIM
from policy.data.lerobot_format import ACTION_KEY, STATE_KEY
from policy.errors import CheckpointError, warned
from policy.files import read_object

CONFIG_FILE = "config.json"
_MAX_TRAIN_STEPS = 10_000
BackboneName = Literal["resnet18", "resnet34", "resnet50", "resnet101", "resnet152"]
Size = tuple[int, int]
"""Height and width."""
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
"""Entries that only training reads, and entries that are read separately from the network's."""


@dataclass(frozen=True, kw_only=True)
class Features:
    """Inputs and outputs of a policy, under LeRobot's names."""

    image_keys: tuple[str, ...]
    """Cameras in the order of their features."""
    image_height: int
    image_width: int
    state_dim: int | None
    """Width of observation.state; None if the policy takes none."""
    modes: Mapping[str, str]
    """Normalisation of STATE, VISUAL and ACTION; see ``plan.MODES``."""


@dataclass(frozen=True, kw_only=True)
class ActConfig:
    """Action Chunking Transformer (Zhao et al. 2023); field names as in config.json."""

    n_obs_steps: ClassVar[int] = 1
    features: Features
    vision_backbone: BackboneName
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
    def horizon(self) -> int:
        """Number of actions from now on."""
        return self.chunk_size

    @property
    def feature_dim(self) -> int:
        """Size of an image's feature: its last map's cells, projected to the transformer's
        width."""
        height, width = map_size(self.features.image_height, self.features.image_width)
        return self.dim_model * height * width


@dataclass(frozen=True, kw_only=True)
class DiffusionConfig:
    """Diffusion policy (Chi et al. 2023) with a 1-D U-Net; field names as in config.json."""

    features: Features
    vision_backbone: BackboneName
    n_obs_steps: int
    predicted: int
    """config.json's horizon: actions of a chunk; the first acts at the oldest observation."""
    resize_shape: Size | None
    crop_shape: Size | None
    use_group_norm: bool
    spatial_softmax_num_keypoints: int
    use_separate_rgb_encoder_per_camera: bool
    down_dims: tuple[int, ...]
    kernel_size: int
    n_groups: int
    diffusion_step_embed_dim: int
    use_film_scale_modulation: bool
    noise_scheduler_type: Literal["DDPM", "DDIM"]
    num_inference_steps: int
    num_train_timesteps: int
    beta_schedule: Literal["squaredcos_cap_v2", "linear", "scaled_linear"]
    beta_start: float
    beta_end: float
    prediction_type: Literal["epsilon", "sample"]
    clip_sample: bool
    clip_sample_range: float

    @property
    def horizon(self) -> int:
        """Number of actions from now on: actions before the newest observation are past."""
        return self.predicted - self.n_obs_steps + 1

    @property
    def feature_dim(self) -> int:
        """Size of an image's feature: two coordinates per keypoint."""
        return 2 * self.spatial_softmax_num_keypoints

    @property
    def encoded_size(self) -> Size:
        """Height and width of the encoder's input image."""
        image = (self.features.image_height, self.features.image_width)
        return self.crop_shape or self.resize_shape or image


Config = ActConfig | DiffusionConfig
C = TypeVar("C", ActConfig, DiffusionConfig)


def map_size(height: int, width: int) -> Size:
    """Return the size of a ResNet's last map: five layers of stride 2, each rounding up."""
    return -(-height // 32), -(-width // 32)


def read_config(folder: Path) -> tuple[Config, list[str]]:
    """Return the policy in a folder, and notes for the user."""
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise CheckpointError(f"{folder}: holds no {CONFIG_FILE}; {_where_to_look(folder)}")
    entries = _Entries(path)
    kind = entries.get("type", Literal["act", "diffusion"])
    if entries.get("use_peft", bool, default=False):
        raise CheckpointError(f"{path}: weights of an adapter (use_peft); merge them before")
    features = _features(entries)
    config: Config
    config = _act(entries, features) if kind == "act" else _diffusion(entries, features)
    notes: list[str] = []
    if unknown := sorted(set(entries.data) - entries.read - _WITHOUT_EFFECT):
        notes.append(
            warned(
                f"{path} has entries that this build does not know: {', '.join(unknown)}. If "
                "they change what the policy computes, it flies wrongly"
            )
        )
    return config, notes


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object of a policy or dataset."""
    return read_object(path, CheckpointError, "folder of LeRobot's")


def _where_to_look(folder: Path) -> str:
    for below in ("pretrained_model", "last/pretrained_model", "checkpoints/last/pretrained_model"):
        if (folder / below / CONFIG_FILE).is_file():
            return f"{folder / below} does: name that one"
    return "name the folder that LeRobot wrote, usually .../checkpoints/last/pretrained_model"


def _act(entries: "_Entries", features: Features) -> ActConfig:
    entries.only("n_obs_steps", 1)
    entries.only("replace_final_stride_with_dilation", False)
    return entries.fill(ActConfig, features=features)


def _diffusion(entries: "_Entries", features: Features) -> DiffusionConfig:
    resize, crop = _resize_and_crop(entries, features)
    if features.state_dim is None:
        raise CheckpointError(f"{entries.path}: a diffusion policy takes {STATE_KEY}")
    if (train_steps := entries.get("num_train_timesteps", int)) > _MAX_TRAIN_STEPS:
        raise CheckpointError(
            f"{entries.path}: num_train_timesteps must be at most {_MAX_TRAIN_STEPS}, got "
            f"{train_steps}: copy the file again"
        )
    config = entries.fill(
        DiffusionConfig,
        features=features,
        predicted=entries.get("horizon", int),
        resize_shape=resize,
        crop_shape=crop,
        num_inference_steps=entries.get("num_inference_steps", int, default=train_steps),
    )
    if config.predicted % 2 ** len(config.down_dims) or config.horizon < 1:
        raise CheckpointError(
            f"{entries.path}: a horizon of {config.predicted} does not suit "
            f"{len(config.down_dims)} down_dims and {config.n_obs_steps} n_obs_steps"
        )
    return config


def _resize_and_crop(entries: "_Entries", features: Features) -> tuple[Size | None, Size | None]:
    # Both came after 0.4.0; before, nothing was resized.
    resize = entries.get("resize_shape", Size | None) if "resize_shape" in entries.data else None
    ratio, crop = (
        entries.get("crop_ratio", float, default=1.0),
        entries.get("crop_shape", Size | None),
    )
    if resize is not None:  # LeRobot then derives the crop from the ratio and ignores crop_shape
        crop = None if ratio == 1.0 else (int(resize[0] * ratio), int(resize[1] * ratio))
    before = resize or (features.image_height, features.image_width)
    if crop is not None and (crop[0] > before[0] or crop[1] > before[1]):
        raise CheckpointError(f"{entries.path}: cannot crop images of {before} to {crop}")
    return resize, crop


def _features(entries: "_Entries") -> Features:
    """Return cameras, state and action; LeRobot uses no STATE feature except observation.state."""
    inputs, outputs = entries.get("input_features", dict), entries.get("output_features", dict)
    kinds = {key: _feature(entries.path, key, value) for key, value in inputs.items()}
    if others := [key for key, (kind, _) in kinds.items() if kind not in ("STATE", "VISUAL")]:
        raise CheckpointError(
            f"{entries.path}: takes {others}, which no vehicle measures; supported are images and "
            f"{STATE_KEY}"
        )
    images = {key: shape for key, (kind, shape) in kinds.items() if kind == "VISUAL"}
    shapes = sorted(set(images.values()))
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
    modes = entries.get("normalization_mapping", dict)
    return Features(
        image_keys=tuple(images),
        image_height=shapes[0][1],
        image_width=shapes[0][2],
        state_dim=state[0] if state else None,
        modes={str(kind): str(mode) for kind, mode in modes.items()},
    )


def _feature(path: Path, key: str, value: object) -> tuple[str, tuple[int, ...]]:
    if isinstance(value, dict):
        kind, shape = value.get("type"), value.get("shape")
        if isinstance(shape, list) and all(isinstance(n, int) and n > 0 for n in shape):
            return str(kind), tuple(shape)
    raise CheckpointError(f"{path}: the feature {key} must have a type and a shape, got {value!r}")


def _are_counts(value: Any) -> bool:
    return isinstance(value, list) and value != [] and all(type(n) is int and n > 0 for n in value)


_KINDS: dict[object, tuple[str, Callable[[Any], bool]]] = {
    bool: ("true or false", lambda value: isinstance(value, bool)),
    int: ("a positive integer", lambda value: type(value) is int and value > 0),
    float: ("a number", lambda value: type(value) in (int, float)),
    dict: ("an object", lambda value: isinstance(value, dict)),
    tuple[int, ...]: ("positive integers", _are_counts),
    Size: ("a height and a width", lambda value: _are_counts(value) and len(value) == 2),
}
"""For each field type, its name in messages and the check of a JSON value."""


class _Entries:
    """Entries of one config.json, each checked when it is read."""

    def __init__(self, path: Path) -> None:
        self.path, self.data = path, read_json(path)
        self.read: set[str] = set()

    def get(self, name: str, kind: Any, *, default: object = None) -> Any:
        """Return an entry of the type ``kind``: also a Literal, or Optional if null is allowed."""
        self.read.add(name)
        value = self.data.get(name)
        value = default if value is None else value
        kinds = [each for each in get_args(kind) if each is not NoneType]
        if value is None and len(kinds) < len(get_args(kind)) and name in self.data:
            return None
        if value is None:
            raise CheckpointError(
                f"{self.path}: no entry {name!r}, and its default differs between versions of "
                "LeRobot: add what it was trained with, or save the policy again with LeRobot"
            )
        if get_origin(kind) is Literal:
            wanted, is_right = f"one of {', '.join(kinds)}", value in kinds
        else:
            wanted, check = _KINDS[kind if kind in _KINDS else kinds[0]]
            is_right = check(value)
        if not is_right:
            raise CheckpointError(f"{self.path}: {name} must be {wanted}, got {value!r}")
        return tuple(value) if isinstance(value, list) else value

    def only(self, name: str, wanted: object) -> None:
        """Raise PolicyError unless the entry has the only supported value."""
        self.read.add(name)
        if (value := self.data.get(name)) != wanted:
            raise CheckpointError(
                f"{self.path}: {name} must be {wanted!r}, which alone is supported, got {value!r}"
            )

    def fill(self, config: type[C], **given: Any) -> C:
        """Return a config filled from the entries with its fields' names, except the given ones."""
        hints = get_type_hints(config)
        names = [each.name for each in fields(config) if each.name not in given]
        read = {name: self.get(name, hints[name]) for name in names}
        return config(**given, **read)
