"""Conversion of torch policies to OpenVINO graphs.

The policy's methods are traced with all modules that it holds. For a user's modules
``torch.export`` runs first, on shapes alone: it rejects decisions by the values of a tensor, which
a trace would silently freeze, and it gives the size and content of the graph before the slow
conversion begins. A built-in network is known by its configuration and weights.
"""

import contextlib
import hashlib
import logging
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import openvino as ov
import torch
from torch import Tensor, nn
from torch.export import ExportedProgram

from policy.engines.openvino_compile import (
    compile_graph,
    engine_name,
    signal_stack_kept,
)
from policy.engines.runner import (
    ArrayFunction,
    Compile,
    ExecutionSettings,
    Precision,
    Shape,
    make_runner,
)
from policy.engines.torch_engines import modules_of, run_eagerly
from policy.errors import PolicyError, user_code
from policy.nets.toge import Toge
from policy.protocol import PolicyRunner, SingleRatePolicy

_MANGLED = re.compile(r"___torch_mangle_\d+\.")
"""In a type's name: TorchScript's counter of equally named types in the process."""
_DECIDES = "it decides by the values of a tensor, which a graph cannot"
MAX_OPERATIONS = 4000
"""Largest number of operations in one graph, 3 ms each to convert; ten unrolled steps of a TOGE are
2,700, one is 500."""
MAX_SCRIPT_OPERATIONS = 20_000
"""Largest number of operations in a TorchScript graph, which counts constants and shapes too."""
MAX_UNROLLED = 10
"""Largest number of steps of a built-in network in one graph; each takes a third of a second to
convert, once."""
MAX_WEIGHTS = 600_000_000
"""Largest number of weights in one graph, each counted once per use: during conversion every use
makes a copy of 4 bytes or more. One step of the largest usual diffusion policy has 263 million."""


@signal_stack_kept()
def make_module_runner(
    converter: "ModuleConverter",
    policy: SingleRatePolicy,
    settings: ExecutionSettings,
    vision: Precision,
    action: Precision,
) -> PolicyRunner:
    """Compile a policy's methods for the loops; tried once.

    A short solve of a built-in network is one graph: half the time of a graph for each step.
    """
    unrolls = isinstance(policy, Toge) and settings.num_diffusion_steps <= MAX_UNROLLED

    def compile_as(precision: Precision) -> Compile:
        return lambda function, shapes: converter.compile(function, shapes, precision)

    return make_runner(
        *(policy, compile_as(vision), compile_as(action)),
        engine=engine_name(vision, action),
        settings=settings,
        compile_end=None if unrolls else run_eagerly(settings.name, "cpu"),
    )


class ModuleConverter:
    """Converts functions of a policy; a graph needed at two precisions is converted once."""

    def __init__(self, policy: object, settings: ExecutionSettings) -> None:
        self._modules = nn.ModuleList(modules_of(policy)).eval()
        self._name = settings.name
        self._known = ""
        """Content of all graphs of a built-in network."""
        if isinstance(policy, Toge):
            digest = hashlib.sha256()
            noise = {"noise": policy.head.initial_noise}
            for name, value in [*policy.state_dict().items(), *noise.items()]:
                update_digest(digest, name, value)
            steps = settings.num_diffusion_steps
            self._known = f"{policy.config} {digest.hexdigest()} {steps} steps"
        self._is_script = any(
            isinstance(module, torch.jit.ScriptModule) for module in self._modules.modules()
        )
        """Traced TorchScript keeps its own decisions by values, and torch.export rejects it."""
        self._models: dict[str, ov.Model] = {}

    def compile(
        self, function: Callable[..., Any], shapes: Sequence[Shape], precision: Precision
    ) -> ArrayFunction:
        """Compile ``function`` of float32 tensors with these shapes, or load it from the cache."""
        module = Traceable(self._modules, lambda *a: _float_tensor(function(*a))).eval()
        examples = tuple(torch.zeros(shape) for shape in shapes)
        with user_code(f"{self._name} cannot be converted"), quiet(), torch.no_grad():
            if self._known:
                digest = f"{self._known} {shapes}"
            elif self._is_script:
                digest = _digest_of_script(module, examples)
            else:
                program = _exported(module, examples)
                _require_bounded(program)
                digest = _digest(program)

            def build() -> ov.Model:
                if digest not in self._models:
                    self._models[digest] = _converted(module, examples)
                return self._models[digest]

            return compile_graph(digest, precision, build)


def _float_tensor(result: object) -> Tensor:
    if not isinstance(result, Tensor):
        raise PolicyError(f"it returns {type(result).__name__}, not a tensor")
    return result.float()


def _exported(module: "Traceable", examples: tuple[Tensor, ...]) -> ExportedProgram:
    try:
        program = torch.export.export(module, examples, strict=False)
    except PolicyError:
        raise
    except Exception as error:
        first = str(error).strip().partition("\n")[0]
        if "data-dependent" in first:
            raise PolicyError(_DECIDES) from error
        raise PolicyError(f"torch.export: {type(error).__name__}: {first}") from error
    if any(node.target is torch.ops.aten.item.default for node in program.graph.nodes):
        raise PolicyError(_DECIDES)
    return program


def _require_bounded(program: ExportedProgram) -> None:
    """Raise PolicyError if a graph would take too long or too much memory to convert."""
    operations = sum(node.op == "call_function" for node in program.graph.nodes)
    weights = sum(value.numel() * uses for _, value, uses in _tensors(program))
    for count, limit, what in (
        (operations, MAX_OPERATIONS, "operations"),
        (weights, MAX_WEIGHTS, "weights, each counted as often as it is used"),
    ):
        if count > limit:
            raise PolicyError(
                f"its graph has {count:,} {what}, and at most {limit:,} are converted: if it loops "
                "over denoising steps, give it the members of protocol.StepwisePolicy"
            )


def _digest(program: ExportedProgram) -> str:
    """Return a digest of the program: operations, constants and weights."""
    digest = hashlib.sha256(program.graph_module.code.encode())
    for name, value, _ in _tensors(program):
        update_digest(digest, name, value)
    return digest.hexdigest()


def _tensors(program: ExportedProgram) -> Iterator[tuple[str, Tensor, int]]:
    """Yield the name, the tensor and the number of uses of each weight and constant."""
    signature = program.graph_signature
    targets = {
        **signature.inputs_to_parameters,
        **signature.inputs_to_buffers,
        **signature.inputs_to_lifted_tensor_constants,
    }
    for node in program.graph.nodes:
        if node.name in targets and node.users:
            target = targets[node.name]
            stored = program.state_dict if target in program.state_dict else program.constants
            yield node.name, stored[target], len(node.users)


def _digest_of_script(module: nn.Module, examples: tuple[Tensor, ...]) -> str:
    """Return a digest, as ``_digest``, of a module that calls TorchScript."""
    graph = _traced(module, examples).inlined_graph
    operations = sum(1 for _ in graph.nodes())
    if operations > MAX_SCRIPT_OPERATIONS:
        raise PolicyError(
            f"its graph has {operations:,} operations, and at most {MAX_SCRIPT_OPERATIONS:,} are "
            "converted: if it loops over denoising steps, export one step as `denoiser`"
        )
    digest = hashlib.sha256(_MANGLED.sub("", str(graph)).encode())
    # A frozen archive's weights are constants, and the text of a graph omits their values.
    constants = [
        ("", node.t("value"))
        for node in graph.findAllNodes("prim::Constant")
        if node.hasAttribute("value") and node.kindOf("value") == "t"
    ]
    for name, value in [*module.state_dict().items(), *constants]:
        update_digest(digest, name, value)
    return digest.hexdigest()


def _converted(module: nn.Module, examples: tuple[Tensor, ...]) -> ov.Model:
    # Traced, not converted from the exported program: its graphs are slower on the CPU, 0.8 ms
    # instead of 0.45 for a step of TOGE in bf16.
    shapes = [list(example.shape) for example in examples]
    return ov.convert_model(_traced(module, examples), example_input=examples, input=shapes)


def _traced(module: nn.Module, examples: tuple[Tensor, ...]) -> Any:
    trace: Any = torch.jit.trace  # without types
    return trace(module, examples, check_trace=False, strict=False)


def update_digest(digest: "hashlib._Hash", name: str, value: Tensor) -> None:
    """Add a weight to a digest."""
    digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
    digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data)


class Traceable(nn.Module):
    """Module that wraps a function of tensors and holds the modules whose weights it uses."""

    def __init__(self, held: nn.Module, function: Callable[..., Any]) -> None:
        super().__init__()
        self.held = held
        self.function = function

    def forward(self, *arrays: Tensor) -> Any:
        """Call the function."""
        return self.function(*arrays)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Silence tracer and converter, and keep them from silencing other loggers permanently."""
    level, disabled = logging.root.level, logging.root.manager.disable
    fast_path = torch.backends.mha.get_fastpath_enabled()
    try:
        logging.disable(logging.CRITICAL)
        # No converter knows the fused layer of torch's own transformers.
        torch.backends.mha.set_fastpath_enabled(False)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # sizes become constants, which is right
            yield
    finally:
        torch.backends.mha.set_fastpath_enabled(fast_path)
        logging.disable(disabled)
        logging.root.setLevel(level)
