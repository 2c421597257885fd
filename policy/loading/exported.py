"""``onnx:PATH`` and ``torchscript:FILE``: policies that another program has exported."""

from pathlib import Path
from typing import TYPE_CHECKING

from policy.adapters.archive import read_description
from policy.adapters.description import Description
from policy.adapters.onnx.files import OnnxFiles, find_onnx_files
from policy.errors import PolicyError
from policy.files import user_path
from policy.loading.request import PolicyRequest
from policy.protocol import SingleRatePolicy

if TYPE_CHECKING:
    from policy.adapters.onnx.policies import OnnxPolicy

ONNX, TORCHSCRIPT = "onnx", "torchscript"


def check_onnx(request: PolicyRequest) -> OnnxFiles:
    """Where its graphs lie and what is said of them, in milliseconds; no graph is read."""
    path = _path(request, "onnx:DIR or onnx:FILE.onnx")
    devices = {request.vision_device or request.device, request.action_device or request.device}
    if request.engine not in ("auto", "openvino") or devices != {"cpu"}:
        raise PolicyError(
            f"--policy {request.spec} runs through OpenVINO on the CPU: leave out --engine and "
            "--device"
        )
    return find_onnx_files(request.spec, path, request.contract_file)


def load_onnx(request: PolicyRequest) -> tuple["OnnxPolicy", list[str]]:
    """The policy in float32, and notes for the user; raises as ``check_onnx``."""
    from policy.adapters.onnx.policies import OnnxGraphs

    graphs = OnnxGraphs(check_onnx(request), request.seed)
    files = [each.name for each in (graphs.files.encoder, graphs.files.rest) if each is not None]
    note = f"{' and '.join(files)} of {graphs.files.rest.parent}"
    if graphs.schedule is not None:
        note += f", solved in {request.num_diffusion_steps} steps from noise of seed {request.seed}"
    return graphs.at("f32", "f32"), [note]


def check_torchscript(request: PolicyRequest) -> Description:
    """What the archive says of itself, in milliseconds; no module of it is loaded."""
    path = _path(request, "torchscript:FILE.pt")
    if not path.is_file():
        raise PolicyError(f"--policy {request.spec}: there is no file {path}")
    return read_description(request.spec, path, request.contract_file)


def load_archive(request: PolicyRequest) -> tuple[SingleRatePolicy, list[str]]:
    """The policy, and notes for the user; raises as ``check_torchscript``."""
    from policy.adapters.torchscript import load_torchscript

    description = check_torchscript(request)
    path = _path(request, "torchscript:FILE.pt")
    policy = load_torchscript(request.spec, path, description, request.seed)
    return policy, [f"TorchScript archive {path}"]


def _path(request: PolicyRequest, form: str) -> Path:
    path = request.spec.partition(":")[2]
    if not path or request.checkpoint is not None:
        raise PolicyError(f"--policy {request.spec}: write {form}, and leave out --checkpoint")
    return user_path(path)
