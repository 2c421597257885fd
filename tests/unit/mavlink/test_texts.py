"""Status texts in pieces."""

from itertools import permutations

import pytest

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.mavlink.codec.messages import StatusText
from mavbridge.mavlink.session.vehicle import TextJoiner

PIECES = [
    StatusText("one, ", 7, 0, is_full=True),
    StatusText("two, ", 7, 1, is_full=True),
    StatusText("three\t", 7, 2),
]


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_pieces_make_a_text_in_any_order(order: tuple[int, ...]) -> None:
    joiner = TextJoiner()
    texts = [text for k in order for text in joiner.receive(PIECES[k], 0)]
    assert texts == ["one, two, three"]
    assert joiner.step(10 * NS_PER_S) == []


def test_a_text_in_one_piece_is_shown_at_once() -> None:
    joiner = TextJoiner()
    assert joiner.receive(StatusText("Armed by external command\t", 1), 0) == [
        "Armed by external command"
    ]
    assert joiner.receive(PIECES[0], 0) == []
    assert joiner.receive(StatusText("PreArm: no"), 0) == ["PreArm: no"]
    assert joiner.receive(PIECES[1], 0) == []
    assert joiner.receive(PIECES[2], 0) == ["one, two, three"]


def test_a_lost_piece_is_waited_for_and_then_shows() -> None:
    joiner = TextJoiner()
    assert joiner.receive(PIECES[0], 0) == joiner.receive(PIECES[2], 0) == []
    assert joiner.step(NS_PER_S) == []
    assert joiner.step(NS_PER_S + NS_PER_MS) == ["one, ...three"]
    assert joiner.receive(PIECES[1], 2 * NS_PER_S) == []
    assert joiner.receive(StatusText("next", 8), 2 * NS_PER_S) == ["...two, ...", "next"]
