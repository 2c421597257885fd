"""Hostile datagrams against a link with a key; `make fuzz` feeds more of them."""

import pytest

from fuzz.signed_target import fuzz_signing


@pytest.mark.parametrize("seed", range(2))
def test_only_packets_signed_with_the_key_are_accepted_and_each_once(seed: int) -> None:
    fuzz_signing(seed, 10_000)
