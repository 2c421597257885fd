"""Each reason has a kind and a sentence, and comes through JSON as it was."""

import ast
import json
import string
from collections.abc import Iterator
from pathlib import Path

import pytest

import mavbridge
from mavbridge.core import reasons
from mavbridge.core.reasons import Code, Kind, Reason, because, reason_from_json, reason_to_json

FORMATTER = string.Formatter()
DISARMED = because(Code.DISARMED)
LATE = {"quantity": "attitude", "age_ms": 104.2, "limit_ms": 100.0, "spent_ms": 131.0}


def example(code: Code) -> Reason:
    """A reason with every figure that its sentence names."""
    data: dict[str, reasons.Value] = {}
    for _, name, spec, _ in FORMATTER.parse(code.sentence):
        if name is not None:
            data[name] = 1.5 if spec else "a word"
    if code in (Code.LATE, Code.PAST_HORIZON):
        data |= LATE | {"place": "computer"}
    return because(code, **data)


@pytest.mark.parametrize("code", Code)
def test_each_reason_can_be_said_and_comes_through_json(code: Code) -> None:
    reason = example(code)
    assert str(reason)
    document = json.loads(json.dumps(reason_to_json(reason)))
    assert reason_from_json(document) == reason
    assert document["code"] == code.value
    assert document["kind"] == reason.kind.value
    assert document["text"] == str(reason)


def test_no_two_reasons_say_the_same() -> None:
    assert len({code.sentence for code in Code}) == len(Code)


@pytest.mark.parametrize(
    ("code", "place", "text"),
    [
        (Code.LATE, "computer", "(limit 100 ms): the computer stood still for 131 ms"),
        (Code.LATE, "link", "(limit 100 ms): the link delivered no attitude for 131 ms"),
        (Code.PAST_HORIZON, "solve", "(its horizon ends after 100 ms): the solve took 131 ms"),
    ],
)
def test_a_late_chunk_names_what_stood_still(code: Code, place: str, text: str) -> None:
    assert str(because(code, **LATE, place=place)) == f"attitude 104 ms old {text}"


def test_a_flight_process_that_answers_did_not_stand_still() -> None:
    late = because(Code.LATE, **LATE, place="flight process", said=because(Code.NOT_FINITE))
    said = "the policy returned a value that is not finite; attitude 104 ms old (limit 100 ms)"
    assert str(late) == said


def test_a_reason_inside_another_keeps_its_code_and_gives_its_kind() -> None:
    both = because(Code.THEN, first=because(Code.DURATION), then=DISARMED)
    assert both.codes == (Code.THEN, Code.DURATION, Code.DISARMED)
    assert both.kind is Kind.END
    assert str(both) == "the flight is over; then the vehicle has been disarmed"
    of_camera = because(Code.OF_CAMERA, camera="front", why=because(Code.NO_IMAGE))
    assert of_camera.kind is Kind.WAITING
    assert reason_from_json(reason_to_json(of_camera)) == of_camera


@pytest.mark.parametrize(
    "document",
    [{}, {"code": "no such"}, {"code": "no such", "data": {}}, {"code": "late", "data": 1}],
)
def test_what_is_no_reason_is_refused(document: dict[str, object]) -> None:
    with pytest.raises((KeyError, TypeError, ValueError)):
        reason_from_json(document)


def _calls() -> Iterator[tuple[str, Code, set[str]]]:
    """Place, code and names of the figures of each ``because(Code.X, ...)`` in the source."""
    for path in sorted(Path(mavbridge.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            match node:
                case ast.Call(
                    func=ast.Name(id="because"),
                    args=[ast.Attribute(value=ast.Name(id="Code"), attr=name)],
                    keywords=keywords,
                ):
                    figures = {each.arg for each in keywords if each.arg is not None}
                    if len(figures) == len(keywords):  # no **figures
                        yield f"{path.name}:{node.lineno}", Code[name], figures


def test_each_reason_that_the_source_makes_has_the_figures_of_its_sentence() -> None:
    calls = list(_calls())
    assert len(calls) > 80
    wrong = [
        (place, code)
        for place, code, figures in calls
        if not figures >= {name for _, name, _, _ in FORMATTER.parse(code.sentence) if name}
    ]
    assert not wrong


def test_the_key_differs_by_words_and_not_by_numbers() -> None:
    old = because(Code.TOO_OLD, quantity="image", age_ms=310.0, limit_ms=300.0)
    older = because(Code.TOO_OLD, quantity="image", age_ms=320.0, limit_ms=300.0)
    other = because(Code.TOO_OLD, quantity="attitude", age_ms=310.0, limit_ms=300.0)
    assert old.key == older.key != other.key
    nested = [because(Code.NOT_ENGAGED_SINCE, why=why).key for why in (old, older, other)]
    assert nested[0] == nested[1] != nested[2]
