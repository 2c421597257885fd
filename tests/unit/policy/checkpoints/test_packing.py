"""Packed weights are close to what they were."""

import torch

from policy.checkpoints.tensors import pack, unpack

STATE = {
    "backbone.conv.weight": torch.randn(8, 3, 3, 3, generator=torch.Generator().manual_seed(0)),
    "backbone.dead.weight": torch.zeros(4, 2, 1, 1),
    "backbone.norm.weight": torch.tensor([1e-9, 1e9]),
    "backbone.norm.num_batches_tracked": torch.tensor(7),
    "head.weight": torch.randn(5, 4, generator=torch.Generator().manual_seed(1)),
}


def test_each_weight_is_off_by_at_most_half_a_step() -> None:
    state = unpack(pack(STATE, coarse="backbone."))
    assert list(state) == list(STATE)
    conv = STATE["backbone.conv.weight"]
    step = conv.flatten(1).abs().amax(dim=1) / 127
    off = (state["backbone.conv.weight"] - conv).flatten(1).abs().amax(dim=1)
    assert bool((off <= 0.5001 * step).all())
    assert bool((off > 0).any())
    torch.testing.assert_close(state["head.weight"], STATE["head.weight"], rtol=2**-11, atol=0)
    for name in (
        "backbone.dead.weight",
        "backbone.norm.weight",
        "backbone.norm.num_batches_tracked",
    ):
        assert torch.equal(state[name], STATE[name])
