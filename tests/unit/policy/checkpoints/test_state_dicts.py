"""What trainers put around weights: taken off where the network then fits, else explained."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from policy.checkpoints.policy_file import build_policy, load_checkpoint_with_notes
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


def lightning(state: State) -> Any:
    return {
        "pytorch-lightning_version": "2.5",
        "epoch": 3,
        "state_dict": {**behind("model.", state), "loss.weight": torch.ones(2)},
        "optimizer_states": [{"state": {0: {"exp_avg": torch.ones(2)}}, "param_groups": []}],
        "hyper_parameters": {"lr": 1e-4},
    }


WRAPPED: list[tuple[str, Callable[[State], Any], str | None]] = [
    ("plain", lambda s: s, None),
    ("lightning", lightning, "weights under 'state_dict.model'"),
    ("ddp", lambda s: behind("module.", s), "weights under 'module'"),
    (
        "trainer",
        lambda s: {"model": s, "optimizer": {"state": {0: {"exp_avg": torch.ones(2)}}}},
        "weights under 'model'",
    ),
    (
        "ema beside",
        lambda s: {"model": with_other(s), "ema": s},
        "averaged weights under 'ema' fly, not those under 'model'",
    ),
    (
        "ema in lightning",
        lambda s: {"state_dict": {**behind("model.", with_other(s)), **behind("ema_model.", s)}},
        "under 'state_dict.ema_model' fly, not those under 'state_dict.model'",
    ),
    (
        "two levels",
        lambda s: {"state_dicts": {"model": with_other(s), "ema_model": s}},
        "under 'state_dicts.ema_model' fly, not those under 'state_dicts.model'",
    ),
]


@pytest.mark.parametrize(
    ("wrap", "note"), [each[1:] for each in WRAPPED], ids=[each[0] for each in WRAPPED]
)
def test_what_is_around_the_weights_is_taken_off_and_said(small_toge, tmp_path, wrap, note):
    state = small_toge.state_dict()
    path = tmp_path / "a.ckpt"
    torch.save(wrap(dict(state)), path)
    policy, notes = load_checkpoint_with_notes(path, fallback=small_toge.config)
    assert torch.equal(policy.state_dict()[NAME], state[NAME])
    assert (notes[0] if notes else None) == note or (note is not None and note in notes[0])


def test_torchs_own_wrappers_load(small_toge: Toge, tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    for wrapped in (AveragedModel(small_toge), nn.Sequential(small_toge)):
        torch.save(wrapped.state_dict(), path)
        policy, _ = load_checkpoint_with_notes(path, fallback=small_toge.config)
        assert torch.equal(policy.state_dict()[NAME], small_toge.state_dict()[NAME])


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda s: torch.optim.Adam([nn.Parameter(s[NAME])]).state_dict(), "no weights found"),
        (lambda s: {"shadow_params": list(s.values())}, "no weights found"),
        (lambda s: nn.Linear(3, 3).state_dict(), r"does not fit .*size and encoder"),
        (
            lambda s: build_policy(TogeConfig(backbone="resnet8")).state_dict(),
            r"does not fit this policy in \d+ places: missing",
        ),
    ],
)
def test_what_holds_no_weights_of_this_network_is_refused(small_toge, tmp_path, wrap, message):
    path = tmp_path / "a.pt"
    torch.save(wrap(dict(small_toge.state_dict())), path)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint_with_notes(path, fallback=small_toge.config)
