import pytest

from mavbridge.config.rates import Rates


@pytest.mark.parametrize(
    ("play_s", "is_dual", "asked_hz", "action_hz"),
    [
        (0.0, True, None, 100.0),
        (0.0, False, None, 30.0),
        (0.4, True, None, 5.0),
        (2.0, False, None, 1.0),
        (60.0, False, None, 0.5),
        (0.01, False, None, 30.0),
        (0.4, True, 50.0, 50.0),
        (0.0, True, 0.5, 0.5),
    ],
)
def test_a_policy_that_plays_its_chunks_is_solved_twice_for_each(
    play_s: float, is_dual: bool, asked_hz: float | None, action_hz: float
) -> None:
    rates = Rates(rate=asked_hz, action_rate=asked_hz)
    loops = rates.loops(is_dual=is_dual, play_s=play_s)
    assert (loops.action_hz, loops.state_hz) == (action_hz, max(action_hz, 50.0))


def test_a_slow_single_rate_policy_finds_an_image_that_has_just_come() -> None:
    assert Rates(rate=1.0).loops(is_dual=False).vision_hz == 30.0
    assert Rates(rate=100.0).loops(is_dual=False).vision_hz == 100.0
