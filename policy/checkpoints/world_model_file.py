"""World models on disk: ``.safetensors`` with the configuration in the header."""

from pathlib import Path

from policy.checkpoints.header import ARCHITECTURE_KEY, CONTRACT_KEY, TRAINING_KEY, require_file
from policy.checkpoints.tensors import read_tensors, require_finite, require_fit, write_tensors
from policy.contract import Contract
from policy.errors import CheckpointError, PolicyError
from policy.nets.world_model.config import WorldModelConfig
from policy.nets.world_model.model import WorldModel

WORLD_MODEL_KEY = "world_model"
"""Header key; a policy's file has ``architecture`` instead."""


def save_world_model(path: Path, model: WorldModel, *, training: str | None = None) -> None:
    """Write weights, in float16, and configuration; replaces ``path`` atomically.

    ``training`` is JSON about the training, for people and reports.
    """
    state = {
        name: value.detach().half().cpu().contiguous() for name, value in model.state_dict().items()
    }
    require_finite(path, state)
    config = model.config
    header = {WORLD_MODEL_KEY: config.to_json(), CONTRACT_KEY: config.contract.to_json()}
    if training is not None:
        header[TRAINING_KEY] = training
    write_tensors(path, state, header)


def load_world_model(path: Path) -> WorldModel:
    """Read a world model, in float32 on the CPU and in eval mode."""
    if path.suffix != ".safetensors":
        raise CheckpointError(f"{path}: world models are stored as .safetensors")
    require_file(path, (".safetensors",))
    header, state = read_tensors(path)
    if WORLD_MODEL_KEY not in header or CONTRACT_KEY not in header:
        held = "a policy" if ARCHITECTURE_KEY in header else f"no world model ({sorted(header)})"
        raise CheckpointError(f"{path} holds {held}: name a file of mavbridge train-world-model")
    require_finite(path, state)
    try:
        contract = Contract.from_json(header[CONTRACT_KEY])
        model = WorldModel(WorldModelConfig.from_json(header[WORLD_MODEL_KEY], contract))
    except PolicyError as error:
        raise CheckpointError(f"{path}: {error}") from error
    require_fit(path, model, state, "Train it again with this version of mavbridge")
    model.load_state_dict(state)
    return model.eval()
