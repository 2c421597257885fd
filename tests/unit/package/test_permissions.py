"""Weights that other users read, as that of a service, have the permissions of the umask."""

import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from helpers.rollouts import TINY
from policy.checkpoints.networks import save_checkpoint, save_world_model
from policy.contract import Contract
from policy.nets.toge import Toge, TogeConfig
from policy.nets.world_model.model import WorldModel

UMASK = 0o027
SMALL = TogeConfig(backbone="resnet8", contract=Contract(image_height=32, image_width=32))


@pytest.mark.parametrize(
    "write",
    [
        lambda path: save_checkpoint(path, Toge(SMALL)),
        lambda path: save_world_model(path, WorldModel(TINY)),
    ],
)
def test_the_umask_decides_who_reads_a_file(write: Callable[[Path], None], tmp_path: Path) -> None:
    """safetensors makes files that only their owner can read; ours go through ``whole_file``."""
    before = os.umask(UMASK)
    try:
        write(tmp_path / "weights.safetensors")
    finally:
        os.umask(before)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert files
    assert {stat.S_IMODE(path.stat().st_mode) for path in files} == {0o666 & ~UMASK}
