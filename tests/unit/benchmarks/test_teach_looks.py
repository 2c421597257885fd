"""Teaching looks: what is drawn, and what is learned from it."""

import numpy as np
import pytest
import torch

from benchmarks import teach_looks
from benchmarks.teach_looks import Kept, Viewpoint, draw, load_toge, loss_of
from policy.loading.builtin import SHIPPED_RATES
from policy.training.run import update_average
from sitl.course import make_course
from sitl.vehicle.dynamics import BodyState

STILL = (0.0, 0.0, 0.0)


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"VIEWS": 8, "VIEWS_OF_A_LOOK": 4, "BATCH": 8}.items():
        monkeypatch.setattr(teach_looks, name, value)


def test_the_encoder_learns_the_nominal_feature_of_other_looks(
    few: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    random, teacher, net = np.random.default_rng(1), *map(load_toge, [SHIPPED_RATES] * 2)
    contract = teacher.contract
    moments = [
        Viewpoint(
            BodyState((8.0 * k, 2.0 * k, -1.5), (1.0, 0.0, 0.0, 0.0), STILL, STILL, STILL, False),
            random.normal(0.0, 0.5, contract.state_dim).astype(np.float32),
            np.zeros((contract.history_len, 4), np.float32),
        )
        for k in range(4)
    ]
    views = draw(700_000, make_course(1), moments, contract)
    assert views.nominal.shape == views.other.shape == (8, 96, 96, 3)
    assert (views.nominal[:4] != views.other[:4]).any()
    kept = Kept(teacher)
    kept.add(views)

    monkeypatch.setattr(teach_looks, "PLAIN_SHARE", 1.0)  # nothing is disturbed
    with torch.inference_mode():
        monkeypatch.setattr(teach_looks, "NOMINAL_SHARE", 1.0)
        nominal = loss_of(net, kept.batch(random))
        monkeypatch.setattr(teach_looks, "NOMINAL_SHARE", 0.0)
        other = loss_of(net, kept.batch(random))
    assert nominal < 0.05 < other  # 0.3 * sqrt(3e-3) + sqrt(1e-3), and bf16

    batch, before = kept.batch(random), load_toge(SHIPPED_RATES)
    optimiser = torch.optim.SGD(net.visual_projection.parameters(), lr=1e-3)
    for _ in range(3):
        loss = loss_of(net, batch)
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
    with torch.inference_mode():
        assert loss_of(net, batch) < loss_of(before, batch)
    update_average(before, net, teach_looks.AVERAGED, 1)
    moved = before.visual_projection[0].weight - teacher.visual_projection[0].weight
    whole = net.visual_projection[0].weight - teacher.visual_projection[0].weight
    torch.testing.assert_close(moved, 9 / 11 * whole)
