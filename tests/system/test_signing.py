"""MAVLink 2 signing, in real processes, against a vehicle that signs by pymavlink."""

import secrets
from pathlib import Path

import pytest

from faults.stage import staged
from helpers.noted_policy import noted_calls, noted_policy

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm", "--policy")
MAIN, VISION, ACTION = "MainThread", "mavbridge-vision", "mavbridge-policy"


def make_key(folder: Path, name: str = "key") -> str:
    path = folder / name
    path.touch(mode=0o600)
    path.write_text(secrets.token_hex(32) + "\n")
    return str(path)


def test_a_signed_flight_of_a_users_file_that_lives_by_the_guide(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    key = make_key(tmp_path)
    recording = tmp_path / "recording"
    flown = (noted_policy(tmp_path), "--takeoff", "2", "--duration", "6")
    flags = ("--signing-key-file", key, "--record", str(recording))
    with staged(tmp_path, "--signing-key-file", key, renders=False) as stage:
        status, output = stage.fly(*FLY, *flown, *flags)
    assert status == 0, output
    assert stage.vehicle_report()["max_altitude_m"] > 1.7
    assert stage.report()["link"]["refused_signatures"] == 0
    assert all(sent.message.get_header().incompat_flags & 1 for sent in stage.relay.sent)
    assert list((tmp_path / "state").rglob("signing/*.json"))
    digits = Path(key).read_text().strip()
    written = [path for path in recording.rglob("*") if path.is_file()]
    assert not [path for path in written if digits.encode() in path.read_bytes()]
    assert digits not in output
    calls = noted_calls(tmp_path)
    assert calls[0] == ("__init__", MAIN)
    assert calls[-1] == ("close", MAIN)
    in_flight = calls[calls.index(("reset", MAIN)) + 1 : -1]
    assert {*in_flight} == {("encode_visual", VISION), ("predict_fast", ACTION), ("reset", ACTION)}
    assert [name for name, _ in calls].count("reset") == 2  # after loading, and for the one flight


@pytest.mark.parametrize("ours", ["none", "another"])
def test_a_vehicle_that_signs_with_another_key_is_recognised(
    ours: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    flags = ("--signing-key-file", make_key(tmp_path, "ours")) if ours == "another" else ()
    key = make_key(tmp_path)
    with staged(tmp_path, "--signing-key-file", key, renders=False) as stage:
        stage.start(*FLY, "scripted:hover", *flags, "--set-config", "link.timeout=10")
        told = "with another key than" if flags else "the vehicle signs its packets"
        assert stage.wait_for(told)
        stage.kill_group(2)
        stage.end()
    assert stage.vehicle_report()["armed_s"] == 0
