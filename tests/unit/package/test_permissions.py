"""Weights that other users read, as that of a service, have the permissions of the umask."""

import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from helpers.rollouts import TINY
from policy.checkpoints.networks import save_checkpoint, save_world_model
from policy.contract import Contract
from policy.nets.toge import Toge, TogeConfig
from policy.nets.world_model.model import WorldModel

UMASK = 0o027


def write_checkpoint(out: Path) -> None:
    contract = Contract(image_height=32, image_width=32)
    save_checkpoint(
        out / "toge.safetensors", Toge(TogeConfig(backbone="resnet8", contract=contract))
    )


def write_world_model(out: Path) -> None:
    save_world_model(out / "world.safetensors", WorldModel(TINY))


@pytest.fixture(autouse=True)
def _umask() -> Iterator[None]:
    before = os.umask(UMASK)
    yield
    os.umask(before)


@pytest.mark.parametrize("write", [write_checkpoint, write_world_model])
def test_the_umask_decides_who_reads_a_file(write: Callable[[Path], None], tmp_path: Path) -> None:
    """safetensors makes files that only their owner can read; ours go through ``whole_file``."""
    out = tmp_path / "out"
    out.mkdir()
    write(out)
    files = [path for path in out.rglob("*") if path.is_file()]
    assert files
    assert {stat.S_IMODE(path.stat().st_mode) for path in files} == {0o666 & ~UMASK}
