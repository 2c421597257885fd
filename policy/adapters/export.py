"""Export of mavbridge's own policies to ONNX or a TorchScript archive.

Both formats hold the encoder, one denoiser step, the contract and the noise schedule.
"""

import json
import warnings
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from policy.adapters.description import DENOISER, DESCRIPTION, ENCODER
from policy.contract import ACTION_DIM
from policy.nets.toge import BuiltinPolicy

OPSET = 18
"""ONNX operator set, from 2022: every runtime in use reads it."""
DENOISER_INPUTS = ("noisy", "timestep", "feature", "state", "action_history")


class _Denoiser(nn.Module):
    """One network call of a solve, in the order of ``DENOISER_INPUTS``."""

    def __init__(self, policy: BuiltinPolicy) -> None:
        super().__init__()
        self.policy = policy

    def forward(
        self,
        noisy: Tensor,
        timestep: Tensor,
        feature: Tensor,
        state: Tensor,
        action_history: Tensor,
    ) -> Tensor:
        state_token = self.policy.state_encoder(state)
        condition = self.policy.condition(feature, state_token, action_history)
        return self.policy.head.denoise(noisy, timestep.long(), condition)


class _Archive(nn.Module):
    """Encoder and denoiser, under the names that ``adapters.modules`` knows."""

    def __init__(self, encoder: nn.Module, denoiser: nn.Module) -> None:
        super().__init__()
        self.visual_encoder, self.denoiser = encoder, denoiser


def _encoder(policy: BuiltinPolicy) -> nn.Module:
    return nn.Sequential(policy.backbone, policy.visual_projection).eval()


def export_onnx(policy: BuiltinPolicy, folder: Path) -> None:
    """Write encoder.onnx, denoiser.onnx and policy.json into ``folder``. Needs the onnx package."""
    image, rest = _examples(policy)
    _write_onnx(_encoder(policy), image, folder / ENCODER, ("image",), "feature")
    denoiser = _Denoiser(policy).eval()
    _write_onnx(denoiser, rest, folder / DENOISER, DENOISER_INPUTS, "prediction")
    (folder / DESCRIPTION).write_text(_description(policy))


def export_torchscript(policy: BuiltinPolicy, path: Path) -> None:
    """Write a TorchScript archive."""
    image, rest = _examples(policy)
    trace: Any = torch.jit.trace  # without types
    script: Any = torch.jit.script
    with _quiet(), torch.no_grad():
        archive = _Archive(
            trace(_encoder(policy), image, check_trace=False),
            trace(_Denoiser(policy).eval(), rest, check_trace=False),
        )
        script(archive).save(path, _extra_files={DESCRIPTION: _description(policy)})


def _write_onnx(
    module: nn.Module, examples: tuple[Tensor, ...], path: Path, inputs: Sequence[str], output: str
) -> None:
    with _quiet(), torch.no_grad():
        # Not torch.export: it takes ten times as long, and its graphs are slower in OpenVINO: one
        # step of TOGE takes 0.58 ms instead of 0.48 in bf16, 1.09 instead of 0.90 in float32.
        torch.onnx.export(
            module,
            examples,
            path,
            input_names=list(inputs),
            output_names=[output],
            opset_version=OPSET,
            dynamo=False,
        )


def _quiet() -> "warnings.catch_warnings[None]":
    return warnings.catch_warnings(action="ignore")  # our shape checks warn


def _examples(policy: BuiltinPolicy) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    contract = policy.contract
    dim = policy.visual_projection[0].out_features
    return (torch.zeros(1, 3, contract.image_height, contract.image_width),), (
        torch.zeros(1, contract.horizon, ACTION_DIM),
        torch.zeros(1),
        torch.zeros(1, int(dim)),  # type: ignore[arg-type]
        torch.zeros(1, contract.state_dim),
        torch.zeros(1, *contract.history_shape),
    )


def _description(policy: BuiltinPolicy) -> str:
    contract = json.loads(policy.contract.to_json())
    described = {"contract": contract, "schedule": asdict(policy.config.schedule)}
    return json.dumps(described, indent=2, sort_keys=True) + "\n"
