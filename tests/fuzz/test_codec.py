"""Hostile datagrams against the codec; `make fuzz` feeds more of them."""

import pytest

from fuzz.codec_target import fuzz_codec


@pytest.mark.parametrize("seed", range(4))
def test_hostile_datagrams_yield_sound_messages_or_none(seed: int) -> None:
    fuzz_codec(seed, 16_000)
