"""Hostile datagrams against the codec, without and with a key; `make fuzz` feeds more of them."""

import pytest

from fuzz.codec_target import fuzz_codec
from fuzz.signed_target import fuzz_signing


@pytest.mark.parametrize("seed", range(4))
def test_hostile_datagrams_yield_sound_messages_or_none(seed: int) -> None:
    fuzz_codec(seed, 16_000)


@pytest.mark.parametrize("seed", range(2))
def test_only_packets_signed_with_the_key_are_accepted_and_each_once(seed: int) -> None:
    fuzz_signing(seed, 10_000)
