"""ONNX graphs behind the policy protocol, on numpy arrays."""

import math
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from policy.adapters.description import USUAL_NAMES
from policy.adapters.modules import make_schedule
from policy.adapters.onnx.files import DENOISER, OnnxFiles
from policy.adapters.onnx.graphs import GraphFile, Ports, Wanted, require_roles
from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.engines.choose import chunks_of_samples, first_with_chunks
from policy.engines.openvino_compile import engine_name, precisions
from policy.engines.parity import make_parity_samples
from policy.engines.runner import (
    ExecutionSettings,
    Precision,
    Shape,
    make_numpy_runner,
)
from policy.engines.stepwise import solver_segment
from policy.errors import PolicyError
from policy.nets.diffusion import NoiseSchedule, flight_noise
from policy.preprocess import input_to_bytes
from policy.protocol import PolicyRunner


class OnnxGraphs:
    """Graphs of a policy, read and checked against its contract."""

    def __init__(self, files: OnnxFiles, seed: int) -> None:
        wanted = _wanted(files)
        self.files = files
        self.seed = seed
        self.schedule = _schedule(files)
        self.encoder: GraphFile | None = None
        contract = replace(files.description.interface.contract, arrays="numpy")
        if files.encoder is not None:
            image = replace(wanted["image"], shape=(1, *contract.image_shape[-3:]))
            ports = _ports(files, {"image": image}, "feature")
            self.encoder = GraphFile(files.encoder, ports)
            contract = _with_feature(contract, self.encoder, files.encoder)
            wanted["feature"] = replace(wanted["feature"], shape=(1, *contract.feature_shape))
        self.interface = replace(files.description.interface, contract=contract)
        needed = ("noisy", "timestep") if files.is_denoiser else ()
        seen = "image" if self.encoder is None else "feature"
        taken = (*needed, seen, "state", "action_history")
        result = "prediction" if files.is_denoiser else "chunk"
        self.rest = GraphFile(
            files.rest, _ports(files, {role: wanted[role] for role in taken}, result)
        )
        if self.rest.hidden and files.is_denoiser:
            raise PolicyError(f"{files.rest}: a denoiser cannot have a hidden state")
        require_roles(self.rest, files.rest, needed)

    def describe(self, num_diffusion_steps: int) -> str:
        """Return a line for the user: the files, and how a denoiser is solved."""
        named = [each.name for each in (self.files.encoder, self.files.rest) if each is not None]
        solved = f", solved in {num_diffusion_steps} steps from noise of seed {self.seed}"
        where = f"{' and '.join(named)} of {self.files.rest.parent}"
        return where if self.schedule is None else where + solved

    def at(self, vision: Precision, action: Precision) -> "OnnxPolicy":
        """Return the policy with its encoder and the rest compiled at these precisions."""
        return (OnnxPolicy if self.encoder is None else EncoderPolicy)(self, vision, action)


class OnnxPolicy:
    """Single rate: one graph makes a chunk from image, state and history."""

    def __init__(self, graphs: OnnxGraphs, _vision: Precision, action: Precision) -> None:
        self.graphs = graphs
        self.contract = graphs.interface.contract
        self._interface = graphs.interface
        self._graph = graphs.rest.compile(action)

    def reset(self) -> None:
        """Forget earlier flights: reset a recurrent graph's hidden state to zeros."""
        self._graph.reset()

    def predict(
        self, image: FloatArray, state: FloatArray, action_history: FloatArray, steps: int
    ) -> FloatArray:
        """Run the graph once."""
        seen = self._image(self.graphs.rest, image)
        return self._interface.to_actions(self._call(state, action_history, image=seen))

    def _call(self, state: FloatArray, history: FloatArray, **arrays: FloatArray) -> FloatArray:
        """Run the graph on a state and a history in the policy's order and units."""
        own_state = self._interface.to_state(state)
        theirs = self._interface.from_actions(history)
        result = self._graph(state=own_state, action_history=theirs, **arrays)
        # Reinforcement-learning policies return one action, without a time axis.
        return result[:, None] if result.ndim == 2 and self.contract.horizon == 1 else result

    def _image(self, graph: GraphFile, image: FloatArray) -> FloatArray:
        """Return the image in the graph's type: normalised by the contract, or uint8."""
        return input_to_bytes(image, self.contract) if graph.takes_bytes else image


class EncoderPolicy(OnnxPolicy):
    """Dual rate: an encoder, and a head that makes a chunk in one call or one step of a solve.

    A solve starts from the same noise as mavbridge's own policies with the same seed.
    """

    def __init__(self, graphs: OnnxGraphs, vision: Precision, action: Precision) -> None:
        super().__init__(graphs, vision, action)
        if graphs.encoder is None:
            raise PolicyError("a policy at two rates needs an encoder")
        self._encoder_file = graphs.encoder
        self._encoder = graphs.encoder.compile(vision)
        self._noise = flight_noise(graphs.seed, self.contract.horizon).numpy()
        solver = partial(solver_segment, self._denoise, graphs.schedule)
        self._solver = lru_cache(maxsize=64)(solver)

    def encode_visual(self, image: FloatArray, camera: int = 0) -> FloatArray:
        """Encode an image [1, 3, H, W] -> feature [1, F]; all cameras share one encoder."""
        return self._encoder(image=self._image(self._encoder_file, image)).reshape(1, -1)

    def predict_fast(
        self, feature: FloatArray, state: FloatArray, action_history: FloatArray, steps: int
    ) -> FloatArray:
        """Call the head once, or run a whole solve."""
        if self.graphs.schedule is None:
            chunk = self._call(state, action_history, feature=feature)
        else:
            chunk = self._solver(steps)(feature, state, action_history, self._noise)
        return self._interface.to_actions(chunk)

    def predict(
        self, image: FloatArray, state: FloatArray, action_history: FloatArray, steps: int
    ) -> FloatArray:
        """Encode the images, then call ``predict_fast``."""
        images = image.reshape(-1, 1, *image.shape[-3:])
        features = np.stack([self.encode_visual(each) for each in images])
        feature = features.reshape(1, *self.contract.feature_shape)
        return self.predict_fast(feature, state, action_history, steps)

    def _denoise(
        self,
        noisy: FloatArray,
        timestep: FloatArray,
        feature: FloatArray,
        state: FloatArray,
        history: FloatArray,
    ) -> FloatArray:
        return self._call(state, history, noisy=noisy, timestep=timestep, feature=feature)


def choose_precision(
    policy: OnnxPolicy, settings: ExecutionSettings
) -> tuple[PolicyRunner, tuple[str, ...]]:
    """Return the runner at the fastest precision that matches float32's actions, with notes.

    ``policy`` is in float32. There is no other reference: the files are trusted to hold the policy.
    """

    def runner_of(vision: Precision, action: Precision) -> PolicyRunner:
        is_given = vision == action == "f32"
        own = policy if is_given else policy.graphs.at(vision, action)
        runner = make_numpy_runner(own, settings)
        return replace(runner, engine=engine_name(vision, action), reset=own.reset)

    reference, samples = runner_of("f32", "f32"), make_parity_samples(policy.contract)
    faster = [
        (engine_name(*pair), partial(runner_of, *pair))
        for pair in precisions()
        if pair != ("f32", "f32")
    ]
    expected = chunks_of_samples(reference, samples)
    runner, notes = first_with_chunks(expected, samples, faster)
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


def _schedule(files: OnnxFiles) -> NoiseSchedule | None:
    if not files.is_denoiser:
        return None
    if any(files.description.interface.action_offset):
        raise PolicyError(
            f"{files.rest}: [action] offset must be zeros for a {DENOISER}, whose noise is about 0"
        )
    return make_schedule(files.rest.parent, files.description.schedule)


def _ports(files: OnnxFiles, inputs: dict[str, Wanted], result: str) -> Ports:
    description = files.description
    return Ports(
        inputs=inputs,
        result=result,
        output=description.outputs.get(result),
        hidden={} if result == "feature" else description.hidden,
    )


def _wanted(files: OnnxFiles) -> dict[str, Wanted]:
    """Return names and shapes of all inputs that a graph of the policy may take."""
    interface, contract = files.description.interface, files.description.interface.contract
    state = (1, *contract.state_shape[:-1], interface.state_dim)
    keys = {"image": interface.camera_keys, "state": (interface.state_key,)}
    shapes: dict[str, Shape] = {
        "image": (1, *contract.image_shape),
        "feature": (1, *contract.feature_shape),
        "state": state,
        "action_history": (1, contract.history_len, ACTION_DIM),
        "noisy": (1, contract.horizon, ACTION_DIM),
        "timestep": (1,),
    }
    return {
        role: Wanted(
            names=(files.description.inputs[role],)
            if role in files.description.inputs
            else (*keys.get(role, ()), *USUAL_NAMES[role]),
            shape=shape,
        )
        for role, shape in shapes.items()
    }
