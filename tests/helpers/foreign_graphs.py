"""ONNX and TorchScript files as exported by other tools, valid and broken, all tiny."""

import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper, parser
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


def save_graph(path: Path, text: str, *, external: bool = False, **weights: np.ndarray) -> None:
    """Write a graph in ONNX's text syntax: ``(inputs) => (outputs) { nodes }``."""
    graph = parser.parse_graph(f"policy {text}")
    graph.initializer.extend(
        numpy_helper.from_array(value, name) for name, value in weights.items()
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    place = {"location": f"{path.name}.data", "size_threshold": 0} if external else {}
    onnx.save_model(model, str(path), save_as_external_data=external, **place)


def port(name: str, shape: Shape, kind: int = FLOAT) -> str:
    """Return an input or output as text."""
    axes = f"[{', '.join(map(str, shape))}]" if shape else ""
    return f'{TensorProto.DataType.Name(kind).lower()}{axes} "{name}"'


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
    actions, *others = outputs
    ends = [port(actions, (1, 4), action_type), *(port(name, (1, 1)) for name in others)]
    nodes = [f'raw = MatMul ("{state}", w)', f"{actions} = Cast <to = {action_type}> (raw)"]
    nodes += [f"{name} = ReduceSum <keepdims = 1> (raw)" for name in others]
    text = f"({port(state, (1, state_dim))}) => ({', '.join(ends)}) {{ {' '.join(nodes)} }}"
    save_graph(path, text, external=external, w=weight)


def recurrent(
    path: Path, *, hidden: Sequence[str] = ("h_in", "h_out"), shape: Shape = (1, 1, 3)
) -> None:
    """Write a policy: obs [1, 13], hidden call counter of a shape -> actions [1, 4].

    Names are those of Isaac Lab's exporter. Throttle is a tenth of the number of calls so far.
    """
    taken, given = hidden
    counter, counted = (port(name, shape) for name in hidden)
    text = f"""(float[1,13] obs, {counter}) => (float[1,4] actions, {counted}) {{
        {given} = Add ({taken}, one)
        count = ReduceMax <keepdims = 0> ({given})
        zeros = MatMul (obs, w)
        throttle = Mul (unit, count)
        actions = Add (zeros, throttle)
    }}"""
    unit = np.array([[0.1, 0, 0, 0]], np.float32)
    save_graph(
        path, text, one=np.ones(shape, np.float32), w=np.zeros((13, 4), np.float32), unit=unit
    )


def image_actor(
    path: Path,
    *,
    kind: int = FLOAT,
    shape: Shape = (1, 3, IMAGE_PX, IMAGE_PX),
    name: str = "image",
) -> None:
    """Write a policy: image of any type and shape -> actions [1, 4], the mean pixel value."""
    text = f"""({port(name, shape, kind)}) => (float[1,4] actions) {{
        pixels = Cast <to = 1> ({name})
        mean = ReduceMean <keepdims = 0> (pixels)
        actions = Mul (unit, mean)
    }}"""
    save_graph(path, text, unit=np.ones((1, 4), np.float32))


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
