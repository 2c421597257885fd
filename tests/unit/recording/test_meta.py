"""What ``meta.json`` says of a flight's end."""

import json
from dataclasses import asdict
from pathlib import Path

from helpers.recordings import make_meta
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import FlightOutcome
from mavbridge.recording.meta import read_meta, write_meta

OUTCOME = FlightOutcome(
    end="duration",
    reason=because(Code.DURATION),
    flown_s=20.0,
    height_m=3.1,
    speed_mps=0.2,
    mode="LOITER",
    is_armed=True,
    is_landed=False,
    gates_total=8,
    gates_passed=5,
    course_s=9.1,
    course_speed_mps=6.3,
    crash=None,
)


def test_the_outcome_is_kept_as_numbers_and_codes(tmp_path: Path) -> None:
    write_meta(tmp_path, make_meta().with_outcome(OUTCOME))
    written = json.loads((tmp_path / "meta.json").read_text())
    reason = {"code": "duration", "kind": "end", "data": {}, "text": "the flight is over"}
    assert written["outcome"] == asdict(OUTCOME) | {"reason": reason}
    assert written["success"] is False, "three gates are missing"
    assert read_meta(tmp_path).outcome == OUTCOME


def test_what_somebody_has_said_of_a_flight_stands() -> None:
    assert make_meta(success=True).with_outcome(OUTCOME).success is True
