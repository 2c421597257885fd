"""Policies and world models on disk.

The header of a ``.safetensors`` file holds the contract and the architecture, so the file is
self-describing. A policy's file also holds a test vector: inputs, and the chunks that plain torch
computed from them when the file was saved. Weights that no longer reproduce these chunks are
rejected. ``.pt`` and ``.pth`` files hold weights only; they are read without executing pickles, and
the caller supplies the rest.
"""

import copy
import json
import pickle
import re
import struct
import warnings
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from policy.checkpoints.header import (
    ARCHITECTURE_KEY,
    CONTRACT_KEY,
    SUFFIXES,
    TRAINING_KEY,
    require_file,
    require_header,
)
from policy.checkpoints.tensors import (
    find_weights,
    load_fitting,
    pack,
    read_tensors,
    require_finite,
    unpack,
    write_tensors,
)
from policy.contract import Contract, FloatArray
from policy.engines.choose import ParitySamples, make_parity_samples, parity_failure
from policy.errors import CheckpointError, PolicyError
from policy.files import parse_object, why_unreadable
from policy.nets.diffusion import NoiseSchedule
from policy.nets.toge import Toge, TogeConfig
from policy.nets.world_model.config import WorldModelConfig
from policy.nets.world_model.model import WorldModel
from policy.preprocess import image_to_input

Config = TypeVar("Config", bound=TogeConfig | WorldModelConfig)
VECTOR_PREFIX = "test_vector."
BACKBONE_PREFIX = "backbone."
KIND_KEY, KIND = "policy", "toge"
"""Entry of an architecture, and its only value."""
VECTOR_NAMES = ("rgb", "state", "history", "chunks")
VECTOR_STEPS = 10
"""Denoising steps of a test vector, or all if the schedule has fewer; its noise has seed 0."""

_DAMAGED = (
    *(OSError, EOFError, RuntimeError, ValueError, LookupError, TypeError, AttributeError),
    *(AssertionError, ArithmeticError, MemoryError, struct.error),
)
"""Exceptions of torch.load for flipped bytes: its reader interprets them before it checks them."""
_UNSUPPORTED = re.compile(r"GLOBAL (\S+)")
"""In an error of torch.load: the class that it refuses to look up."""
WORLD_MODEL_KEY = "world_model"
"""Header key; a policy's file has ``architecture`` instead."""


def save_checkpoint(
    path: Path, policy: Toge, *, training: str = "{}", packed: bool = False
) -> None:
    """Write weights, contract, architecture and a test vector; replaces ``path`` atomically.

    ``training`` is JSON about the training, for people and reports. ``packed`` shrinks the file to
    a third, with rounding as in ``pack``; the test vector is then computed from the rounded
    weights.
    """
    state = {name: value.detach().contiguous() for name, value in policy.state_dict().items()}
    require_finite(path, state)
    if packed:
        state = pack(state, coarse=BACKBONE_PREFIX)
        policy = copy.deepcopy(policy)
        policy.load_state_dict(unpack(state))
    for name, value in _make_vector(policy).items():
        state[VECTOR_PREFIX + name] = value
    architecture = config_json(policy.config, **{KIND_KEY: KIND})
    contract = policy.contract.to_json()
    header = {CONTRACT_KEY: contract, ARCHITECTURE_KEY: architecture, TRAINING_KEY: training}
    write_tensors(path, state, header)


def load_checkpoint(path: Path, *, fallback: TogeConfig) -> Toge:
    """Read a checkpoint into its network, on the CPU, in eval mode.

    ``fallback`` is the requested policy: its values supply everything that a ``.pt`` lacks.
    """
    require_file(path, SUFFIXES)
    config, vector = fallback, {}
    if path.suffix == ".safetensors":
        header, tensors = read_tensors(path)
        require_header(path, header)
        config = _config_of(path, header, ARCHITECTURE_KEY, TogeConfig)
        ours = [name for name in tensors if name.startswith(VECTOR_PREFIX)]
        vector = {name.removeprefix(VECTOR_PREFIX): tensors.pop(name) for name in ours}
        state = unpack(tensors)
    else:
        state = _read_torch(path)
    policy = load_fitting(
        *(path, partial(Toge, config), state),
        "Name the size and encoder of its training, as in --policy toge:medium:resnet18, or save "
        "the network's own state_dict()",
    )
    if vector:
        _require_reproduced(path, policy, vector)
    return policy


def _make_vector(policy: Toge) -> dict[str, Tensor]:
    """Return inputs, and the chunks that plain torch computes from them in float32 on a CPU."""
    reference = copy.deepcopy(policy).cpu().eval()
    samples = make_parity_samples(policy.contract)
    arrays = (samples.rgb, samples.state, samples.history, _chunks(reference, samples))
    # safetensors requires contiguous tensors.
    tensors = (torch.from_numpy(np.ascontiguousarray(array)) for array in arrays)
    return dict(zip(VECTOR_NAMES, tensors, strict=True))


@torch.inference_mode()
def _chunks(policy: Toge, samples: ParitySamples) -> FloatArray:
    policy.head.seed_noise(0)
    images = np.concatenate([image_to_input(rgb, policy.contract) for rgb in samples.rgb])
    steps = min(VECTOR_STEPS, policy.config.schedule.num_train_timesteps)
    image, state, history = map(torch.from_numpy, (images, samples.state, samples.history))
    chunks: FloatArray = policy.predict(image, state, history, steps).numpy()
    return chunks


def _require_reproduced(path: Path, policy: Toge, vector: dict[str, Tensor]) -> None:
    damaged = f"{path}: its test vector is damaged"
    if set(vector) != set(VECTOR_NAMES):
        raise CheckpointError(f"{damaged}: it must hold {list(VECTOR_NAMES)}, not {sorted(vector)}")
    kinds = {name: torch.uint8 if name == "rgb" else torch.float32 for name in VECTOR_NAMES}
    if bad := [name for name, kind in kinds.items() if vector[name].dtype != kind]:
        raise CheckpointError(
            f"{damaged}: its {bad[0]} must be {kinds[bad[0]]}, not {vector[bad[0]].dtype}; copy "
            "the file again"
        )
    require_finite(path, vector)
    rgb, state, history, chunks = (vector[name].numpy() for name in VECTOR_NAMES)
    try:
        made = _chunks(policy, ParitySamples(rgb=rgb, state=state, history=history))
    except (PolicyError, RuntimeError, ValueError) as error:
        raise CheckpointError(f"{damaged}: {error}; copy the file again") from error
    if (reason := parity_failure(chunks, made)) is not None:
        raise CheckpointError(
            f"{path}: these weights do not make the sticks that they made where they were saved: "
            f"{reason}. The file is damaged, or of another version: copy or export it again"
        )


def config_json(config: TogeConfig | WorldModelConfig, **more: str) -> str:
    """Return the header form of a configuration: without the contract, which has its own entry."""
    data = asdict(config) | more
    del data["contract"]
    return json.dumps(data, sort_keys=True)


def _config_of(path: Path, header: dict[str, str], key: str, wanted: type[Config]) -> Config:
    """Return the configuration under ``key`` of a file's header."""
    text = header[key]
    try:
        contract = Contract.from_json(header[CONTRACT_KEY])
        data = parse_object(text, CheckpointError, f"malformed {key}: it")
        if (found := data.pop(KIND_KEY, KIND)) != KIND:
            raise CheckpointError(f"it holds a {found}, which is no network of ours")
        return wanted(contract=contract, schedule=NoiseSchedule(**data.pop("schedule")), **data)
    except PolicyError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except (ArithmeticError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"{path}: malformed {key} {text[:200]!r} ({error}): export the checkpoint again"
        ) from error


def _read_torch(path: Path) -> dict[str, Tensor]:
    """Read weights saved by torch; executes no pickle."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about file formats; serious faults are rejected below
            loaded: object = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        named = _UNSUPPORTED.search(str(error))
        held = f"a pickle that holds a {named[1]}" if named else "damaged, or no pickle of tensors"
        raise CheckpointError(
            f"{path} is {held}, and loading that could run any program. Where it was trained save "
            "model.state_dict() alone, for a network of this project; for another one save "
            "torch.jit.trace(model, example) (--policy torchscript:FILE), or write a class that "
            "builds it (--policy ./file.py:Class)"
        ) from error
    except _DAMAGED as error:
        raise CheckpointError(why_unreadable(path, error)) from error
    if not isinstance(loaded, dict):
        raise CheckpointError(
            f"{path}: holds a {type(loaded).__name__}, not a dict of weights; "
            "save model.state_dict()"
        )
    if "contract" in loaded:
        raise CheckpointError(
            f"{path}: holds a contract, which is not read from a torch file: save it as "
            ".safetensors, or the weights alone"
        )
    return find_weights(path, loaded)


def save_world_model(path: Path, model: WorldModel, *, training: str = "{}") -> None:
    """Write float16 weights and configuration, atomically; ``training``: JSON for people."""
    state = {
        name: value.detach().half().cpu().contiguous() for name, value in model.state_dict().items()
    }
    require_finite(path, state)
    config, contract = config_json(model.config), model.config.contract.to_json()
    header = {WORLD_MODEL_KEY: config, CONTRACT_KEY: contract, TRAINING_KEY: training}
    write_tensors(path, state, header)


def load_world_model(path: Path) -> WorldModel:
    """Read a world model, in float32 on the CPU and in eval mode."""
    require_file(path, (".safetensors",))
    header, state = read_tensors(path)
    if WORLD_MODEL_KEY not in header or CONTRACT_KEY not in header:
        held = "a policy" if ARCHITECTURE_KEY in header else f"no world model ({sorted(header)})"
        raise CheckpointError(f"{path} holds {held}: name a file of mavbridge train-world-model")
    config = _config_of(path, header, WORLD_MODEL_KEY, WorldModelConfig)
    return load_fitting(
        *(path, partial(WorldModel, config), state), "Train it again with this version of mavbridge"
    )
