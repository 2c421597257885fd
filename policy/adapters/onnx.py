"""ONNX graphs, compiled by OpenVINO, behind the policy protocol on numpy arrays."""

import hashlib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import openvino as ov

from policy.adapters.description import USUAL_NAMES, OnnxFiles, read_graph
from policy.adapters.modules import DenoiserPolicy, ForwardPolicy, HeadPolicy, make_schedule
from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.engines.choose import fastest_like
from policy.engines.openvino_compile import (
    Graph,
    compile_graph,
    engine_name,
    precisions,
    signal_stack_kept,
)
from policy.engines.runner import ExecutionSettings, Precision, Shape, make_runner, run_in_numpy
from policy.errors import CheckpointError, PolicyError
from policy.files import last_line
from policy.preprocess import input_to_bytes
from policy.protocol import PolicyRunner

_ALONE = {2: "state", 4: "image"}
"""Role of a graph's only input by its number of axes, if the name tells nothing."""
_HIDDEN_IN = re.compile(r"(.+)_in(_\d+)?")
_FLOATS = ("f16", "bf16", "f32", "f64")
Compiled = tuple[ForwardPolicy, Callable[[], None]]
"""Policy, and the reset of its hidden state to zeros."""


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """Accepted names of one policy input, and its shape with a batch of one."""

    names: tuple[str, ...]
    shape: Shape


class RoleGraph:
    """Compiled graph with its hidden state, zeros at first; for one thread."""

    def __init__(
        self, graph: Graph, shapes: Mapping[str, Sequence[int]], hidden: Mapping[str, Shape]
    ) -> None:
        self._graph, self._shapes, self._hidden_shapes = graph, shapes, hidden
        self.reset()

    def reset(self) -> None:
        """Set the hidden state to zeros."""
        shapes = self._hidden_shapes.items()
        self._hidden = {name: np.zeros(shape, np.float32) for name, shape in shapes}

    def __call__(self, **arrays: FloatArray) -> FloatArray:
        """Run the graph on float32 arrays by role; arrays that it does not take are ignored."""
        given = arrays | self._hidden if self._hidden else arrays
        result = self._graph(*[given[role].reshape(s) for role, s in self._shapes.items()])
        if self._hidden:
            self._hidden = dict(zip(self._hidden, self._graph.rest(), strict=True))
        return result


class GraphFile:
    """ONNX file that is read once and can be compiled at any precision."""

    @signal_stack_kept()
    def __init__(
        self,
        path: Path,
        inputs: Mapping[str, Wanted],
        result: str,
        output: str | int | None = None,
        hidden: Mapping[str, str] | None = None,
    ) -> None:
        """Read a file, and find the expected inputs, by role, and the output.

        ``result`` is one of ``description.RESULTS``; ``output`` and ``hidden`` are as there.
        """
        self._path = path
        model = read_graph(path)
        pairs = self._hidden_pairs(model, hidden or {})
        visible = [port for port in model.inputs if not port.get_names() & set(pairs)]
        roles = [
            next(iter(port.get_names() & set(pairs)), "")
            or self._role(port, inputs, is_alone=len(visible) == 1)
            for port in model.inputs
        ]
        if len(set(roles)) < len(roles):
            raise CheckpointError(
                f"{path}: two inputs have one role: {roles}. Export one input for each; several "
                "cameras are one image [1, cameras, channels, height, width]"
            )
        self.roles = roles
        """Role of each input, in the graph's order; the role of a hidden input is its name."""
        self.takes_bytes = self._require_types(model, roles, pairs)
        """True if the image is uint8, 0 to 255."""
        self.hidden = {
            name: _sizes(model.inputs[roles.index(name)]) for name in roles if name in pairs
        }
        kept = [
            self._output(model, result, output, pairs),
            *(model.output(pairs[n]) for n in self.hidden),
        ]
        self._kept = [sorted(port.get_names()) for port in kept]
        self._model = ov.Model(
            [port.get_node().input_value(0) for port in kept], model.get_parameters(), "policy"
        )
        self._make_static({role: each.shape for role, each in inputs.items()} | self.hidden)
        for port in self._model.outputs:
            if (shape := port.get_partial_shape()).is_dynamic:
                why = "which depends on the values of the inputs: export one of a fixed size"
                raise CheckpointError(f"{path}: an output has the shape {shape}, {why}")
        self.output_shape, *carried = (tuple(port.shape) for port in self._model.outputs)
        for (name, taken), given in zip(self.hidden.items(), carried, strict=True):
            if taken != given:  # as a cache that grows by each call
                told = f"{name} is {list(taken)} and its output {pairs[name]} {list(given)}"
                raise CheckpointError(f"{path}: hidden input {told}: they must be of one shape")

    @signal_stack_kept()
    def compile(self, precision: Precision) -> RoleGraph:
        """Compile the graph, or load it from the user's cache.

        Raises:
            RuntimeError: OpenVINO cannot compile it.
        """
        shapes = [list(port.shape) for port in self._model.inputs]
        subject = f"{_digest(self._path, self._model)} {shapes} {self._kept}"
        graph = compile_graph(subject, precision, lambda: self._model)
        return RoleGraph(graph, dict(zip(self.roles, shapes, strict=True)), self.hidden)

    def _hidden_pairs(self, model: "ov.Model", given: Mapping[str, str]) -> dict[str, str]:
        """Return the output that feeds each hidden input at the next call, by name."""
        inputs, outputs = (
            {name for port in side for name in port.get_names()}
            for side in (model.inputs, model.outputs)
        )
        pairs = {
            name: f"{found[1]}_out{found[2] or ''}"
            for name in inputs
            if (found := _HIDDEN_IN.fullmatch(name)) is not None
        }
        pairs = {name: out for name, out in pairs.items() if out in outputs} | dict(given)
        for name, out in pairs.items():
            if name not in inputs or out not in outputs:
                raise CheckpointError(
                    f'{self._path} has no input {name} with an output {out}, as "hidden" in '
                    f"policy.json says; it has {sorted(inputs)} and {sorted(outputs)}"
                )
        return pairs

    def _role(self, port: "ov.Output", wanted: Mapping[str, Wanted], *, is_alone: bool) -> str:
        names, rank = port.get_names(), port.get_partial_shape().rank
        by_axes = _ALONE.get(rank.get_length(), "") if rank.is_static else ""
        for role, each in wanted.items():
            if names & set(each.names):
                is_image = role == "state" and by_axes == "image"  # an "obs" may be either
                return by_axes if is_image and by_axes in wanted else role
        if is_alone and by_axes in wanted:
            return by_axes
        known = {role: list(each.names) for role, each in wanted.items()}
        raise CheckpointError(
            f"{self._path}: input {sorted(names)} is unknown; known names by meaning are {known}. "
            'Say what it is in policy.json, "inputs": {"state": "its name"}, or by --contract'
        )

    def _require_types(self, model: "ov.Model", roles: list[str], pairs: Mapping[str, str]) -> bool:
        """Raise PolicyError for unsupported element types; return True if the image is uint8."""
        takes_bytes = False
        for port, role in zip(model.inputs, roles, strict=True):
            kind = port.get_element_type().get_type_name()
            if role == "image" and kind == "u8":
                takes_bytes = True
            elif kind not in _FLOATS and not (role == "timestep" and kind in ("i32", "i64")):
                raise CheckpointError(
                    f"{self._path}: input {sorted(port.get_names())} is of type {kind}, and the "
                    f"contract's {role} is made of floating-point numbers (an image may be uint8, "
                    "0 to 255): export the graph with float inputs"
                )
        for port in model.outputs:
            kind = port.get_element_type().get_type_name()
            if port.get_names() & set(pairs.values()) and kind not in _FLOATS:
                raise CheckpointError(f"{self._path}: hidden output of type {kind}, not a float")
        return takes_bytes

    def _output(
        self, model: "ov.Model", result: str, asked: str | int | None, pairs: Mapping[str, str]
    ) -> "ov.Output":
        """Return the output that holds the requested result."""
        visible = [port for port in model.outputs if not port.get_names() & set(pairs.values())]
        names = [
            ", ".join(sorted(port.get_names())) or f"number {at}" for at, port in enumerate(visible)
        ]
        chosen = [
            port for at, port in enumerate(visible) if asked in port.get_names() or asked == at
        ]
        if asked is None and len(visible) == 1:
            chosen = visible
        if len(chosen) != 1:
            said = f"no output {asked!r}" if asked is not None else f"{len(visible)} outputs"
            raise CheckpointError(
                f"{self._path} has {said} ({'; '.join(names)}): say which is the {result}, "
                f'in policy.json beside it, "outputs": {{"{result}": "its name"}}'
            )
        kind = chosen[0].get_element_type().get_type_name()
        if kind not in _FLOATS:
            raise CheckpointError(
                f"{self._path}: its {result} is of type {kind}, and the contract's numbers "
                "are not whole: what do they count? Export the continuous actions"
            )
        return chosen[0]

    def _make_static(self, wanted: Mapping[str, Shape]) -> None:
        model = self._model
        shapes = {}
        for port, role in zip(model.inputs, self.roles, strict=True):
            shapes[port] = list(wanted[role])
            declared = port.get_partial_shape()
            sizes = list(declared) if declared.rank.is_static else []
            if declared.is_static and [1, *declared.to_shape()] == shapes[port]:
                shapes[port].pop(0)  # it has no axis for the batch
                continue
            is_reshaped = role != "image" and 0 < len(sizes) != len(shapes[port])
            if is_reshaped and math.prod(_sizes(port)[1:]) == math.prod(shapes[port][1:]):
                shapes[port] = [1, *_sizes(port)[1:]]  # the same numbers, flat or with more axes
                continue
            axes = zip(reversed(sizes), reversed(shapes[port][1:]), strict=False)  # no batch
            if any(axis.is_static and axis.get_length() != size for axis, size in axes):
                raise CheckpointError(
                    f"{self._path}: its {role} is {declared}, and by the contract {shapes[port]}: "
                    "set image_height, image_width, history_len, horizon or [state] names to the "
                    "file's sizes, or export it with the contract's (channels first)"
                )
        try:
            model.reshape(shapes)
            process = ov.preprocess.PrePostProcessor(model)
            for at in range(len(model.inputs)):
                process.input(at).tensor().set_element_type(ov.Type.f32)
            for at in range(len(model.outputs)):
                process.output(at).tensor().set_element_type(ov.Type.f32)
            self._model = process.build()
        except RuntimeError as error:
            asked = dict(zip(self.roles, shapes.values(), strict=True))
            theirs = [str(port.get_partial_shape()) for port in model.inputs]
            raise CheckpointError(
                f"{self._path} takes {theirs}, and by the contract its inputs would be {asked}: "
                f"{last_line(error)}"
            ) from error


def _sizes(port: "ov.Output") -> Shape:
    """Return a port's shape, with 1 for each axis of unknown size."""
    return tuple(size.get_length() if size.is_static else 1 for size in port.get_partial_shape())


def _digest(path: Path, model: ov.Model) -> str:
    """Return a digest of the file and of the weights in external files."""
    digest = hashlib.sha256(path.read_bytes())
    for node in model.get_ordered_ops():
        if node.get_type_name() == "Constant":
            digest.update(np.ascontiguousarray(node.data).view(np.uint8).data)
    return digest.hexdigest()


class OnnxGraphs:
    """Graphs of a policy, read and checked against its contract."""

    def __init__(self, files: OnnxFiles, seed: int) -> None:
        wanted, description = _wanted(files), files.description
        self.files, self.seed = files, seed
        self._encoder: GraphFile | None = None
        contract = replace(description.interface.contract, arrays="numpy")
        seen = "image"
        if files.encoder is not None:
            image = replace(wanted["image"], shape=(1, *contract.image_shape[-3:]))
            output = description.outputs.get("feature")
            self._encoder = GraphFile(files.encoder, {"image": image}, "feature", output)
            if self._encoder.hidden:  # its calls and the reset run in two threads
                raise PolicyError(
                    f"{files.encoder}: an encoder cannot have a hidden state, got "
                    f"{list(self._encoder.hidden)}: keep it in the head, or export one policy.onnx"
                )
            contract = _with_feature(contract, self._encoder, files.encoder)
            wanted["feature"] = replace(wanted["feature"], shape=(1, *contract.feature_shape))
            seen = "feature"
        self.interface = replace(description.interface, contract=contract)
        needed = ("noisy", "timestep") if files.is_denoiser else ()
        self._taken = (*needed, seen, "state", "action_history")
        result = "prediction" if files.is_denoiser else "chunk"
        self._rest = GraphFile(
            files.rest,
            {role: wanted[role] for role in self._taken},
            result,
            description.outputs.get(result),
            description.hidden,
        )
        if self._rest.hidden and files.is_denoiser:
            raise PolicyError(f"{files.rest}: a denoiser cannot have a hidden state")
        if missing := [role for role in needed if role not in self._rest.roles]:
            raise PolicyError(f"{files.rest} takes {self._rest.roles}, but no {missing}")

    def describe(self, num_diffusion_steps: int) -> str:
        """Return a line for the user: the files, and how a denoiser is solved."""
        named = [each.name for each in (self.files.encoder, self.files.rest) if each is not None]
        solved = f", solved in {num_diffusion_steps} steps from noise of seed {self.seed}"
        where = f"{' and '.join(named)} of {self.files.rest.parent}"
        return where + solved if self.files.is_denoiser else where

    def at(self, vision: Precision, action: Precision) -> Compiled:
        """Return the policy with its encoder and the rest compiled at these precisions."""
        rest, interface = self._rest.compile(action), self.interface
        to_image = self._image_of(self._rest)

        def call(*arrays: FloatArray) -> FloatArray:
            given = dict(zip(self._taken, arrays, strict=True))
            if "image" in given:
                given["image"] = to_image(given["image"])
            return rest(**given)

        if self._encoder is None:
            return ForwardPolicy(interface, call), rest.reset
        encoder, to_seen = self._encoder.compile(vision), self._image_of(self._encoder)

        def encode(image: FloatArray) -> FloatArray:
            return encoder(image=to_seen(image)).reshape(1, -1)

        if not self.files.is_denoiser:
            return HeadPolicy(interface, encode, call), rest.reset
        schedule = make_schedule(self.files.rest.parent, self.files.description.schedule)
        return DenoiserPolicy(interface, encode, call, schedule, self.seed), rest.reset

    def _image_of(self, graph: GraphFile) -> Callable[[FloatArray], FloatArray]:
        """Return the conversion of a normalised image to the graph's type: uint8 or the same."""
        if graph.takes_bytes:
            return lambda image: input_to_bytes(image, self.interface.contract)
        return lambda image: image

    def make_runner(
        self, in_float32: Compiled, settings: ExecutionSettings
    ) -> tuple[PolicyRunner, tuple[str, ...]]:
        """Return the runner at the fastest precision that matches float32's actions, with notes.

        There is no other reference: the files are trusted to hold the policy.
        """
        run = run_in_numpy(settings.name)

        def runner_of(vision: Precision, action: Precision) -> PolicyRunner:
            is_given = vision == action == "f32"
            policy, reset = in_float32 if is_given else self.at(vision, action)
            name = engine_name(vision, action)
            runner = make_runner(
                *(policy, run, run), engine=name, settings=settings, compile_end=run
            )
            return replace(runner, reset=reset) if self._rest.hidden else runner

        faster = [
            (engine_name(*pair), partial(runner_of, *pair))
            for pair in precisions()
            if pair != ("f32", "f32")
        ]
        return fastest_like(runner_of("f32", "f32"), faster)


def _with_feature(contract: Contract, encoder: GraphFile, path: Path) -> Contract:
    dim = math.prod(encoder.output_shape)
    if contract.feature_dim not in (0, dim):
        raise PolicyError(
            f"{path} makes {dim} numbers of an image, and the contract says feature_dim "
            f"{contract.feature_dim}"
        )
    return replace(contract, feature_dim=dim)


def _wanted(files: OnnxFiles) -> dict[str, Wanted]:
    """Return names and shapes of all inputs that a graph of the policy may take."""
    interface, contract = files.description.interface, files.description.interface.contract
    keys = {"image": interface.camera_keys, "state": (interface.state_key,)}
    shapes: dict[str, Shape] = {
        "image": (1, *contract.image_shape),
        "feature": (1, *contract.feature_shape),
        "state": (1, *contract.state_shape[:-1], interface.state_dim),
        "action_history": (1, *contract.history_shape),
        "noisy": (1, contract.horizon, ACTION_DIM),
        "timestep": (1,),
    }
    named = {role: (name,) for role, name in files.description.inputs.items()}
    return {
        role: Wanted(names=named.get(role, (*keys.get(role, ()), *USUAL_NAMES[role])), shape=shape)
        for role, shape in shapes.items()
    }
