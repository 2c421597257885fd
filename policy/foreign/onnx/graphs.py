"""One ONNX file as a compiled graph whose inputs are given by their role."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import openvino as ov

from policy.contract import FloatArray
from policy.engines.executable import Precision, Shape
from policy.engines.openvino_compile import Graph, GraphCompiler
from policy.engines.signal_stack import signal_stack_kept
from policy.errors import CheckpointError, PolicyError

USUAL_NAMES: dict[str, tuple[str, ...]] = {
    "image": ("image", "images", "rgb", "pixels"),
    "feature": ("feature", "features", "global_cond"),
    "state": ("state", "proprio"),
    "action_history": ("action_history", "history"),
    "noisy": ("noisy", "noisy_action", "noisy_actions", "sample"),
    "timestep": ("timestep", "timesteps", "t"),
}
"""Names by which an input is known where nothing else is said."""


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """What one input of a policy is called, and its shape with the batch of one."""

    names: tuple[str, ...]
    shape: Shape


class RoleGraph:
    """A compiled graph; for one thread."""

    def __init__(self, graph: Graph, roles: list[str], output_shape: Shape) -> None:
        self._graph = graph
        self.roles = roles
        """Role of each input, in the graph's order."""
        self.output_shape = output_shape

    def __call__(self, **arrays: FloatArray) -> FloatArray:
        """Run it on float32 arrays by role; those that it does not take are left out."""
        return self._graph(*[arrays[role] for role in self.roles])


class GraphFile:
    """An ONNX file, read once and compiled at any precision.

    Raises:
        CheckpointError: it cannot be read, its inputs cannot be told apart, or it does not take
            the contract's shapes.
    """

    @signal_stack_kept()
    def __init__(self, path: Path, wanted: Mapping[str, Wanted]) -> None:
        self._path = path
        try:
            self._model = ov.Core().read_model(path)
        except RuntimeError as error:
            raise CheckpointError(f"{path} cannot be read as ONNX: {_reason(error)}") from error
        self.roles = [self._role(port, wanted) for port in self._model.inputs]
        if len(set(self.roles)) < len(self.roles):
            raise CheckpointError(f"{path}: two inputs are the {_twice(self.roles)}")
        self._make_static(wanted)
        self.output_shape = tuple(self._model.outputs[0].shape)

    @signal_stack_kept()
    def compile(self, precision: Precision) -> RoleGraph:
        """Compile it, or take it from the user's cache.

        Raises:
            RuntimeError: OpenVINO cannot compile it.
        """
        shapes = [list(port.shape) for port in self._model.inputs]
        compiler = GraphCompiler(f"{_digest(self._path, self._model)} {shapes}")
        graph = compiler.compile("onnx", precision, lambda: self._model)
        return RoleGraph(graph, self.roles, self.output_shape)

    def _role(self, port: "ov.Output", wanted: Mapping[str, Wanted]) -> str:
        names = port.get_names()
        for role, each in wanted.items():
            if names & set(each.names):
                return role
        known = {role: list(each.names) for role, each in wanted.items()}
        raise CheckpointError(
            f"{self._path}: input {sorted(names)} is unknown; known names by meaning are {known}. "
            'Say what it is in policy.json, "inputs": {"state": "its name"}, or by --contract'
        )

    def _make_static(self, wanted: Mapping[str, Wanted]) -> None:
        model = self._model
        shapes = {}
        for port, role in zip(model.inputs, self.roles, strict=True):
            scalar = role == "timestep" and port.get_partial_shape().rank == ov.Dimension(0)
            shapes[port] = [] if scalar else list(wanted[role].shape)
        try:
            model.reshape(shapes)
            process = ov.preprocess.PrePostProcessor(model)
            for at in range(len(model.inputs)):
                process.input(at).tensor().set_element_type(ov.Type.f32)
            process.output(0).tensor().set_element_type(ov.Type.f32)
            self._model = process.build()
        except RuntimeError as error:
            asked = dict(zip(self.roles, shapes.values(), strict=True))
            theirs = [str(port.get_partial_shape()) for port in model.inputs]
            raise CheckpointError(
                f"{self._path} takes {theirs}, and by the contract its inputs would be {asked}: "
                f"{_reason(error)}"
            ) from error


def require_roles(file: GraphFile, path: Path, roles: tuple[str, ...]) -> None:
    """Refuse a graph that does not take an input without which it cannot be what it should be."""
    if missing := [role for role in roles if role not in file.roles]:
        raise PolicyError(f"{path} takes {file.roles}, but not the {' and the '.join(missing)}")


def _twice(roles: list[str]) -> str:
    return next(role for role in roles if roles.count(role) > 1)


def _reason(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__


def _digest(path: Path, model: ov.Model) -> str:
    """A text that differs wherever the file, or weights that lie in other files, do."""
    digest = hashlib.sha256(path.read_bytes())
    for node in model.get_ordered_ops():
        if node.get_type_name() == "Constant":
            digest.update(np.ascontiguousarray(node.data).view(np.uint8).data)
    return digest.hexdigest()
