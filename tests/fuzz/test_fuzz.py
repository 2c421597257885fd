"""Hostile datagrams against codec, signatures and flights; `make fuzz` feeds more of them."""

import pytest

from fuzz.codec_target import fuzz_codec
from fuzz.link_target import HostileFlight
from fuzz.signed_target import fuzz_signing
from mavbridge.core.vehicle import ActionKind
from sitl.vehicle.config import AutopilotName


@pytest.mark.parametrize("seed", range(2))
def test_hostile_datagrams_yield_sound_messages_or_none(seed: int) -> None:
    fuzz_codec(seed, 16_000)


def test_only_packets_signed_with_the_key_are_accepted_and_each_once() -> None:
    fuzz_signing(1, 10_000)


@pytest.mark.parametrize(
    ("autopilot", "kind"),
    [("ardupilot", "sticks"), ("ardupilot", "velocity"), ("px4", "sticks"), ("px4", "rates")],
)
def test_hostile_datagrams_neither_fly_nor_break_anything(
    autopilot: AutopilotName, kind: ActionKind
) -> None:
    share = 1100 if autopilot == "ardupilot" else 550
    flight = HostileFlight(1, autopilot, kind, share=share)
    flight.run(4 * share)
    assert flight.fed >= 4 * share
    assert flight.flights >= 1
