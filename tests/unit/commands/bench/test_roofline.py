import pytest
import torch
from torch import nn

from mavbridge.commands.bench.roofline import count_work, floor_ms


@pytest.mark.parametrize(
    ("flop", "num_bytes", "expected_ms"),
    [(2e9, 0.0, 20.0), (0.0, 40e6, 4.0), (2e9, 40e6, 20.0), (2e8, 40e6, 4.0)],
)
def test_the_floor_is_the_slower_of_arithmetic_and_traffic(
    flop: float, num_bytes: float, expected_ms: float
) -> None:
    floor = floor_ms(flop=flop, num_bytes=num_bytes, flop_per_s=100e9, bytes_per_s=10e9)
    assert floor == pytest.approx(expected_ms)


def test_counts_products_and_the_weights_as_often_as_they_are_used() -> None:
    layer = nn.Linear(8, 16, bias=False)

    def twice() -> torch.Tensor:
        layer(torch.zeros(4, 8))
        result: torch.Tensor = layer(torch.zeros(4, 8))
        return result

    work = count_work("two products", twice, {layer: 2})
    assert work.flop == 2 * (2 * 4 * 8 * 16)
    assert work.weight_uses == 2 * 8 * 16
    assert work.distinct_weights == 8 * 16
