import pytest
import torch
from torch import nn

from benchmarks import roofline
from benchmarks.roofline import LEAST_BUFFER_BYTES, MATRIX_SIDE, Work, count_work, floor_ms


def test_counts_products_and_the_weights_as_often_as_they_are_used() -> None:
    layer = nn.Linear(8, 16, bias=False)

    def twice() -> torch.Tensor:
        layer(torch.zeros(4, 8))
        result: torch.Tensor = layer(torch.zeros(4, 8))
        return result

    work = count_work(twice, {layer: 2})
    assert work.flop == 2 * (2 * 4 * 8 * 16)
    assert work.weight_uses == 2 * 8 * 16
    assert work.distinct_weights == 8 * 16


@pytest.mark.parametrize(
    ("work", "expected_ms"),
    [
        (Work(flop=4 * MATRIX_SIDE**3, weight_uses=0, distinct_weights=0), 2000.0),
        (Work(flop=0, weight_uses=LEAST_BUFFER_BYTES, distinct_weights=1), 4000.0),
        (Work(flop=4 * MATRIX_SIDE**3, weight_uses=LEAST_BUFFER_BYTES, distinct_weights=1), 4000.0),
    ],
)
def test_the_floor_is_the_slower_of_arithmetic_and_traffic(
    work: Work, expected_ms: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(roofline, "best_s", lambda call: 1.0)  # a product, or a buffer, a second
    assert floor_ms(work, torch.float32) == expected_ms
