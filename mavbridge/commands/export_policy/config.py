"""Settings of ``mavbridge export-policy``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cyclopts import Parameter

ExportFormat = Literal["onnx", "torchscript"]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ExportPolicyConfig:
    """What is written, and where."""

    out: Path
    """Folder for encoder.onnx, denoiser.onnx and policy.json; or the archive's file, .pt."""
    format: ExportFormat = "onnx"
    """onnx: encoder, one denoising step, contract and schedule. torchscript: the same in one
    archive."""
    policy: str = "toge"
    """Kind of the policy: toge or resnet-unet."""
