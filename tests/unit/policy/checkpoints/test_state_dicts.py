"""What trainers put around weights: taken off where the network then fits, else explained."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from policy.checkpoints.networks import load_checkpoint_with_notes
from policy.errors import CheckpointError
from policy.nets.toge import Toge, TogeConfig

NAME = "fusion.mlp.0.weight"
State = dict[str, Tensor]


def behind(prefix: str, state: State) -> State:
    return {prefix + name: value for name, value in state.items()}


def with_other(state: State) -> State:
    """Weights of the same names that are not these."""
    return {
        name: value + 1 if value.is_floating_point() else value for name, value in state.items()
    }


WRAPPED: dict[str, tuple[Callable[[State], Any], str | None]] = {
    "plain": (lambda s: s, None),
    "lightning": (
        lambda s: {
            "epoch": 3,
            "state_dict": {**behind("model.", s), "loss.weight": torch.ones(2)},
            "optimizer_states": [{"state": {0: {"exp_avg": torch.ones(2)}}, "param_groups": []}],
        },
        "weights under 'state_dict.model'",
    ),
    "ddp": (lambda s: behind("module.", s), "weights under 'module'"),
    "ema beside": (
        lambda s: {
            "model": with_other(s),
            "ema": s,
            "optimizer": {"state": {0: {"exp_avg": torch.ones(2)}}},
        },
        "averaged weights under 'ema' fly, not those under 'model'",
    ),
    "ema in lightning": (
        lambda s: {"state_dict": {**behind("model.", with_other(s)), **behind("ema_model.", s)}},
        "under 'state_dict.ema_model' fly, not those under 'state_dict.model'",
    ),
    "two levels": (
        lambda s: {"state_dicts": {"model": with_other(s), "ema_model": s}},
        "under 'state_dicts.ema_model' fly, not those under 'state_dicts.model'",
    ),
}


@pytest.mark.parametrize("case", WRAPPED)
def test_wrappers_of_weights_are_removed_and_reported(small_toge, tmp_path, case):
    wrap, note = WRAPPED[case]
    state = small_toge.state_dict()
    path = tmp_path / "a.ckpt"
    torch.save(wrap(dict(state)), path)
    policy, notes = load_checkpoint_with_notes(path, fallback=small_toge.config)
    assert torch.equal(policy.state_dict()[NAME], state[NAME])
    assert note in notes[0] if note else not notes


def test_torchs_own_average_loads(small_toge: Toge, tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    torch.save(AveragedModel(small_toge).state_dict(), path)
    policy, _ = load_checkpoint_with_notes(path, fallback=small_toge.config)
    assert torch.equal(policy.state_dict()[NAME], small_toge.state_dict()[NAME])


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda s: torch.optim.Adam([nn.Parameter(s[NAME])]).state_dict(), "no weights found"),
        (lambda s: {"shadow_params": list(s.values())}, "no weights found"),
        (
            lambda s: Toge(TogeConfig(backbone="resnet18")).state_dict(),
            r"does not fit this policy in \d+ places: missing.*size and encoder",
        ),
    ],
)
def test_files_without_weights_of_this_network_are_refused(small_toge, tmp_path, wrap, message):
    path = tmp_path / "a.pt"
    torch.save(wrap(dict(small_toge.state_dict())), path)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_with_notes(path, fallback=small_toge.config)
