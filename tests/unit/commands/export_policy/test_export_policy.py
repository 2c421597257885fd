"""``mavbridge export-policy``: what it writes, and that it compares."""

import json
from pathlib import Path

import numpy as np
import openvino as ov
import pytest
import torch

from mavbridge.commands import convert
from mavbridge.commands.config import ExportPolicyConfig
from mavbridge.commands.convert import export_policy
from mavbridge.core.errors import UserError
from policy.adapters.export import _write_onnx
from policy.contract import Contract, FloatArray
from policy.nets.resnet import build_backbone


def test_the_shipped_policy_is_written_as_onnx(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep" / "toge"
    assert export_policy(None, ExportPolicyConfig(out=out)) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "denoiser.onnx", "encoder.onnx", "policy.json",
    ]  # fmt: skip
    described = json.loads((out / "policy.json").read_text())
    assert set(described) == {"contract", "schedule"}
    Contract.from_json(json.dumps(described["contract"]))
    said = capsys.readouterr().err
    assert "it agrees with torch" in said
    assert f"--policy onnx:{out}" in said
    with pytest.raises(UserError, match="is taken: name a new or empty folder"):
        export_policy(None, ExportPolicyConfig(out=out))


@pytest.mark.parametrize("image_size", [32, 96, 100])
def test_an_encoder_of_any_image_size_is_written_as_onnx(tmp_path: Path, image_size: int) -> None:
    image, path = torch.rand(1, 3, image_size, image_size), tmp_path / "encoder.onnx"
    encoder = build_backbone("resnet8").eval()
    _write_onnx(encoder, (image,), path, ("image",), "feature")
    written = ov.Core().compile_model(path, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    feature = encoder(image).detach().numpy()
    np.testing.assert_allclose(written(image.numpy())[0], feature, rtol=1e-3, atol=1e-4)


def test_files_that_are_another_policy_are_not_praised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared: list[FloatArray] = []

    def chunks_of_samples(*_: object) -> FloatArray:
        compared.append(np.full((8, 16, 4), 0.1 + 0.02 * len(compared), np.float32))
        return compared[-1]

    monkeypatch.setattr(convert, "chunks_of_samples", chunks_of_samples)
    config = ExportPolicyConfig(out=tmp_path / "toge")
    with pytest.raises(UserError, match=r"another policy: an action is off by 0\.02"):
        export_policy(None, config)
