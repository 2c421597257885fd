"""ONNX and TorchScript files as exported by other tools, valid and broken, all tiny."""

import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from policy.adapters.description import DESCRIPTION
from policy.files import CONTRACT_FILE

IMAGE_PX = 32
CONTRACT = f"""[contract]
horizon = {{horizon}}
chunk_dt_s = 0.05
image_height = {IMAGE_PX}
image_width = {IMAGE_PX}
image_mean_rgb = [0.0, 0.0, 0.0]
image_std_rgb = [1.0, 1.0, 1.0]
"""
Shape = Sequence[int | str]
FLOAT = TensorProto.FLOAT


def write_contract(folder: Path, *, horizon: int = 1, more: str = "") -> None:
    (folder / CONTRACT_FILE).write_text(CONTRACT.format(horizon=horizon) + more)


def describe(folder: Path, **tables: Mapping[str, object]) -> None:
    (folder / DESCRIPTION).write_text(json.dumps(tables))


def save_graph(
    path: Path,
    nodes: Sequence[Any],
    inputs: Mapping[str, tuple[int, Shape]],
    outputs: Mapping[str, tuple[int, Shape]],
    weights: Mapping[str, np.ndarray],
    **save: object,
) -> None:
    """Write a graph; ``inputs`` and ``outputs`` are element type and shape by name."""
    ends = [
        [helper.make_tensor_value_info(name, kind, list(shape)) for name, (kind, shape) in side]
        for side in (inputs.items(), outputs.items())
    ]
    tensors = [numpy_helper.from_array(value, name) for name, value in weights.items()]
    graph = helper.make_graph(list(nodes), "policy", *ends, tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.save_model(model, str(path), **save)


def actor(
    path: Path,
    *,
    state: str = "obs",
    state_dim: int = 13,
    outputs: Sequence[str] = ("actions",),
    action_type: int = FLOAT,
    external: bool = False,
) -> None:
    """Write a reinforcement learning policy: state [1, S] -> actions [1, 4], more if requested.

    Each of the four numbers is 0.1 times the first number of the state, a velocity.
    """
    weight = np.zeros((state_dim, 4), np.float32)
    weight[0] = 0.1
    nodes = [helper.make_node("MatMul", [state, "w"], ["raw"])]
    kind = action_type
    nodes.append(helper.make_node("Cast", ["raw"], [outputs[0]], to=kind))
    nodes += [helper.make_node("ReduceSum", ["raw"], [name], keepdims=1) for name in outputs[1:]]
    ends = {outputs[0]: (kind, (1, 4))} | dict.fromkeys(outputs[1:], (FLOAT, (1, 1)))
    save: dict[str, object] = {}
    if external:
        save = {"save_as_external_data": True, "location": f"{path.name}.data", "size_threshold": 0}
    save_graph(path, nodes, {state: (FLOAT, (1, state_dim))}, ends, {"w": weight}, **save)


def recurrent(
    path: Path, *, hidden: Sequence[str] = ("h_in", "h_out"), shape: Shape = (1, 1, 3)
) -> None:
    """Write a policy: obs [1, 13], hidden call counter of a shape -> actions [1, 4].

    Names are those of Isaac Lab's exporter. Throttle is a tenth of the number of calls so far.
    """
    taken, given = hidden
    nodes = [
        helper.make_node("Add", [taken, "one"], [given]),
        helper.make_node("ReduceMax", [given], ["count"], keepdims=0),
        helper.make_node("MatMul", ["obs", "w"], ["zeros"]),
        helper.make_node("Mul", ["count", "tenth"], ["throttle"]),
        helper.make_node("Mul", ["unit", "throttle"], ["up"]),
        helper.make_node("Add", ["zeros", "up"], ["actions"]),
    ]
    weights = {
        "one": np.ones(shape, np.float32),
        "w": np.zeros((13, 4), np.float32),
        "tenth": np.array(0.1, np.float32),
        "unit": np.array([[1.0, 0.0, 0.0, 0.0]], np.float32),
    }
    state = (FLOAT, shape)
    save_graph(
        path,
        nodes,
        {"obs": (FLOAT, (1, 13)), taken: state},
        {"actions": (FLOAT, (1, 4)), given: state},
        weights,
    )


def image_actor(
    path: Path,
    *,
    kind: int = FLOAT,
    shape: Shape = (1, 3, IMAGE_PX, IMAGE_PX),
    name: str = "image",
) -> None:
    """Write a policy: image of any type and shape -> actions [1, 4], the mean pixel value."""
    nodes = [
        helper.make_node("Cast", [name], ["pixels"], to=FLOAT),
        helper.make_node("ReduceMean", ["pixels"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["unit", "mean"], ["actions"]),
    ]
    weights = {"unit": np.ones((1, 4), np.float32)}
    save_graph(path, nodes, {name: (kind, shape)}, {"actions": (FLOAT, (1, 4))}, weights)


class StateActor(nn.Module):
    """forward(x) of an observation alone, as rsl_rl and Isaac Lab export it."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(13, 4, bias=False)
        with torch.no_grad():
            self.layer.weight.zero_()[:, 0] = 0.1

    def forward(self, x: Tensor) -> Tensor:
        """obs [B, 13] -> actions [B, 4]."""
        actions: Tensor = self.layer(x)
        return actions


class TupleActor(nn.Module):
    """Actions, value and log probability, as Stable Baselines' policies return them."""

    def forward(self, image: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """state [B, 13] -> actions [B, 4], value [B, 1], log_prob [B]."""
        actions = 0.1 * state[:, :1].repeat(1, 4)
        return actions, actions.sum(1, keepdim=True), actions.sum(1)


class CountingActor(nn.Module):
    """Recurrent policy as rsl_rl exports it: the hidden state is a buffer, with ``reset``."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("hidden_state", torch.zeros(1))

    def forward(self, image: Tensor, state: Tensor) -> Tensor:
        """Return a throttle of a tenth of the number of calls so far."""
        self.hidden_state += 1.0
        return torch.cat([0.1 * self.hidden_state[None], torch.zeros(1, 3)], 1) + 0.0 * state[:, :1]

    @torch.jit.export
    def reset(self) -> None:
        self.hidden_state[:] = 0.0


def save_script(path: Path, module: nn.Module) -> None:
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        torch.jit.save(torch.jit.script(module), str(path))  # type: ignore[no-untyped-call]
