"""Hostile datagrams against a link with a key; `make fuzz` feeds more of them."""

import pytest

from fuzz.signed_target import fuzz_signing


@pytest.mark.parametrize("seed", range(2))
def test_nothing_is_taken_but_what_the_holder_of_the_key_has_signed_and_once(seed: int) -> None:
    fuzz_signing(seed, 10_000)
