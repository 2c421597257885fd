import io
import pickle

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.torch import save

from policy.checkpoints.networks import load_checkpoint
from policy.contract import Contract
from policy.errors import CheckpointError
from policy.nets.toge import TogeConfig

FALLBACK = TogeConfig(
    backbone="resnet18", contract=Contract(image_height=32, image_width=32, horizon=4)
)


def torch_file(*, as_zip: bool) -> bytes:
    buffer = io.BytesIO()
    torch.save({"weight": torch.ones(3)}, buffer, _use_new_zipfile_serialization=as_zip)
    return buffer.getvalue()


FILES = {
    "zip.pt": torch_file(as_zip=True),
    "legacy.pt": torch_file(as_zip=False),
    "pickle.pth": pickle.dumps({"weight": [1, 2, 3]}, protocol=2),
    "plain.safetensors": save({"weight": torch.ones(3)}, {"contract": "{}", "architecture": "{}"}),
}


@pytest.mark.parametrize("name", FILES)
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_and_missing_bytes_are_refused(tmp_path, name, data):
    """None of these files fits a policy, so nothing but a refusal may come out, however damaged."""
    content = bytearray(FILES[name])
    places = st.integers(0, len(content) - 1)
    flips = st.lists(st.tuples(places, st.integers(0, 255)), max_size=8)
    for place, value in data.draw(flips):
        content[place] = value
    path = tmp_path / name
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    with pytest.raises(CheckpointError):
        load_checkpoint(path, fallback=FALLBACK)
