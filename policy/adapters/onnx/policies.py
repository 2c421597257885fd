"""ONNX graphs behind the policy protocol, on numpy arrays."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from policy.adapters.description import USUAL_NAMES
from policy.adapters.modules import DenoiserPolicy, ForwardPolicy, HeadPolicy, make_schedule
from policy.adapters.onnx.files import OnnxFiles
from policy.adapters.onnx.graphs import GraphFile, Wanted
from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.engines.choose import chunks_of_samples, first_with_chunks
from policy.engines.openvino_compile import engine_name, precisions
from policy.engines.parity import make_parity_samples
from policy.engines.runner import ExecutionSettings, Precision, Shape, make_runner, run_in_numpy
from policy.errors import PolicyError
from policy.preprocess import input_to_bytes
from policy.protocol import PolicyRunner

Compiled = tuple[ForwardPolicy, Callable[[], None]]
"""Policy, and the reset of its hidden state to zeros."""


class OnnxGraphs:
    """Graphs of a policy, read and checked against its contract."""

    def __init__(self, files: OnnxFiles, seed: int) -> None:
        wanted, description = _wanted(files), files.description
        self.files = files
        self.seed = seed
        self._encoder: GraphFile | None = None
        contract = replace(description.interface.contract, arrays="numpy")
        seen = "image"
        if files.encoder is not None:
            image = replace(wanted["image"], shape=(1, *contract.image_shape[-3:]))
            output = description.outputs.get("feature")
            self._encoder = GraphFile(files.encoder, {"image": image}, "feature", output)
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
            runner = make_runner(
                *(policy, policy, run, run),
                engine=engine_name(vision, action),
                settings=settings,
                compile_end=run,
            )
            return replace(runner, reset=reset)

        reference, samples = runner_of("f32", "f32"), make_parity_samples(self.interface.contract)
        faster = [
            (engine_name(*pair), partial(runner_of, *pair))
            for pair in precisions()
            if pair != ("f32", "f32")
        ]
        runner, notes = first_with_chunks(chunks_of_samples(reference, samples), samples, faster)
        if runner is not None:
            return runner, (*notes, f"engine {runner.engine}: agrees with float32")
        return reference, (*notes, f"engine {reference.engine}")


def _with_feature(contract: Contract, encoder: GraphFile, path: Path) -> Contract:
    dim = math.prod(encoder.output_shape[1:])
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
