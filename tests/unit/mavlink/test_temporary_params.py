"""Parameters that are set for one flight: confirmed, remembered, put back."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.parameters import ParamVehicle, lossy
from mavbridge.core.reasons import Code, because

WANTED = (("RC_OVERRIDE_TIME", 0.5),)
SET = [("RC_OVERRIDE_TIME", 0.5)]


def start(folder: Path, *, time_s: float = 3.0, **more: Any) -> ParamVehicle:
    flags: dict[str, Any] = {"set_params": WANTED} | more
    return ParamVehicle({"RC_OVERRIDE_TIME": time_s}, folder=folder, **flags)


def again(before: ParamVehicle, **flags: Any) -> ParamVehicle:
    """A later start of ours, with the same vehicle."""
    return ParamVehicle(folder=before.folder, values=before.values, **flags)


def remembered(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "vehicle-1-ab12.json").read_text())
    return found["parameters"]  # type: ignore[no-any-return]


def end(vehicle: ParamVehicle, *, within_s: float = 5.0) -> None:
    vehicle.params.begin_restore()
    vehicle.run(within_s)
    assert vehicle.params.is_restored


def told(vehicle: ParamVehicle, text: str) -> bool:
    return any(text in line for line in vehicle.texts)


def test_a_parameter_is_set_before_the_flight_and_put_back_after_it(tmp_path: Path) -> None:
    vehicle = start(tmp_path / "state")
    assert vehicle.problem() is not None
    vehicle.run(6.0)
    assert vehicle.problem() is None
    assert vehicle.values["RC_OVERRIDE_TIME"] == 0.5
    assert vehicle.writes == SET
    assert told(vehicle, "RC_OVERRIDE_TIME set from 3 to 0.5 for this flight")
    assert not told(vehicle, "last sticks for that many seconds")  # it is mended
    assert not vehicle.params.is_restored
    end(vehicle, within_s=0.1)
    assert vehicle.values["RC_OVERRIDE_TIME"] == 3.0
    assert told(vehicle, "RC_OVERRIDE_TIME put back to 3")
    assert list((tmp_path / "state").iterdir()) == []


def test_the_old_value_is_on_disk_before_the_new_one_is_sent(tmp_path: Path) -> None:
    vehicle = start(tmp_path)
    while not vehicle.writes:
        assert list(tmp_path.iterdir()) == []
        vehicle.step()
    assert remembered(tmp_path) == {"RC_OVERRIDE_TIME": {"before": 3.0, "ours": [0.5]}}


def test_a_refused_risk_is_mended_by_setting_it(tmp_path: Path) -> None:
    vehicle = start(tmp_path, time_s=-1.0)
    vehicle.run(6.0)
    assert vehicle.problem() is None
    end(vehicle)
    assert vehicle.values["RC_OVERRIDE_TIME"] == -1.0


@pytest.mark.parametrize("seed", range(5))
def test_setting_and_putting_back_survive_losses(tmp_path: Path, seed: int) -> None:
    vehicle = start(tmp_path, loses=lossy(0.3, seed))
    vehicle.run(15.0)
    assert vehicle.problem() is None
    assert vehicle.values["RC_OVERRIDE_TIME"] == 0.5
    end(vehicle)
    assert vehicle.values["RC_OVERRIDE_TIME"] == 3.0
    assert list(tmp_path.iterdir()) == []


def test_a_value_that_the_vehicle_does_not_take_forbids_the_flight(tmp_path: Path) -> None:
    vehicle = start(tmp_path)
    vehicle.refuses.add("RC_OVERRIDE_TIME")
    vehicle.run(10.0)
    assert "did not take --set RC_OVERRIDE_TIME=0.5: it stays at 3" in str(vehicle.problem())
    assert len(vehicle.writes) == 6
    assert list(tmp_path.iterdir()) == []  # nothing to put back
    vehicle.set_by_pilot("RC_OVERRIDE_TIME", 0.5)
    assert vehicle.problem() is None
    end(vehicle)
    assert vehicle.values["RC_OVERRIDE_TIME"] == 0.5  # the pilot's doing, not ours


def test_a_vehicle_that_does_not_confirm_may_have_taken_it(tmp_path: Path) -> None:
    vehicle = start(tmp_path)
    while not vehicle.writes:
        vehicle.step()
    vehicle.fall_silent()
    vehicle.run(5.0)
    assert "it does not answer" in str(vehicle.problem())
    assert "RC_OVERRIDE_TIME" in remembered(tmp_path)


def test_a_parameter_that_does_not_exist_forbids_the_flight(tmp_path: Path) -> None:
    vehicle = ParamVehicle(folder=tmp_path, set_params=(("RC_OVERIDE_TIME", 0.5),))
    vehicle.run(6.0)
    assert "no such parameter; check its name" in str(vehicle.problem())
    assert vehicle.writes == []


def test_nothing_is_set_or_put_back_while_armed(tmp_path: Path) -> None:
    vehicle = start(tmp_path)
    vehicle.armed = True
    vehicle.run(6.0)
    said = "--set and --restore-params wait until the vehicle is disarmed"
    assert vehicle.problem() == because(Code.PARAMETERS, said=said)
    assert vehicle.writes == []
    vehicle.armed = False
    vehicle.run(1.0)
    assert vehicle.problem() is None
    vehicle.armed = True
    vehicle.run(1.0)
    end(vehicle, within_s=0.1)
    assert vehicle.writes == SET
    assert told(vehicle, "still armed, so what was set for the flight stays: RC_OVERRIDE_TIME (it")
    assert "RC_OVERRIDE_TIME" in remembered(tmp_path)


def test_arming_while_something_is_put_back_stops_that(tmp_path: Path) -> None:
    vehicle = start(tmp_path)
    vehicle.run(6.0)
    vehicle.refuses.add("RC_OVERRIDE_TIME")
    vehicle.params.begin_restore()
    vehicle.run(0.7)
    vehicle.armed = True
    count = len(vehicle.writes)
    vehicle.run(5.0)
    assert vehicle.params.is_restored
    assert len(vehicle.writes) == count
    assert told(vehicle, "still armed")
    assert "RC_OVERRIDE_TIME" in remembered(tmp_path)


def test_arming_while_something_is_set_stops_that_until_it_is_disarmed(tmp_path: Path) -> None:
    vehicle = start(tmp_path)
    vehicle.refuses.add("RC_OVERRIDE_TIME")
    while not vehicle.writes:
        vehicle.step()
    vehicle.armed = True
    vehicle.refuses.clear()
    vehicle.run(5.0)
    assert vehicle.writes == SET
    assert "wait until the vehicle is disarmed" in str(vehicle.problem())
    vehicle.armed = False
    vehicle.run(1.0)
    assert vehicle.values["RC_OVERRIDE_TIME"] == 0.5
    assert vehicle.problem() is None


def test_a_vehicle_that_is_gone_at_the_end_keeps_the_file(tmp_path: Path) -> None:
    vehicle = start(tmp_path)
    vehicle.run(6.0)
    vehicle.fall_silent()
    end(vehicle)
    assert told(vehicle, "RC_OVERRIDE_TIME could not be put back to 3")
    assert "RC_OVERRIDE_TIME" in remembered(tmp_path)


def test_an_end_before_anything_was_set_sets_nothing(tmp_path: Path) -> None:
    vehicle = start(tmp_path)
    vehicle.run(0.1)
    end(vehicle, within_s=6.0)
    assert vehicle.writes == []
    assert list(tmp_path.iterdir()) == []


def test_an_end_while_a_write_is_on_its_way_puts_back(tmp_path: Path) -> None:
    vehicle = start(tmp_path)
    while not vehicle.writes:
        vehicle.step()
    end(vehicle)  # without having heard the confirmation
    assert vehicle.values["RC_OVERRIDE_TIME"] == 3.0
    assert list(tmp_path.iterdir()) == []


def test_what_another_station_has_set_meanwhile_is_left(tmp_path: Path) -> None:
    vehicle = start(tmp_path)
    vehicle.run(6.0)
    vehicle.set_by_pilot("RC_OVERRIDE_TIME", 0.8)
    assert vehicle.problem() is None
    end(vehicle)
    assert vehicle.values["RC_OVERRIDE_TIME"] == 0.8
    assert list(tmp_path.iterdir()) == []


# --- after a crash


def test_a_later_start_offers_to_put_back_what_a_crash_has_left(tmp_path: Path) -> None:
    crashed = start(tmp_path)
    crashed.run(6.0)
    offered = again(crashed)
    offered.run(6.0)
    assert offered.problem() is None
    assert offered.writes == []
    expected = "left over from an earlier flight that did not end in order: RC_OVERRIDE_TIME was 3"
    assert told(offered, f"{expected} and is now 0.5; --restore-params puts it back")
    end(offered)  # it was only offered
    assert offered.values["RC_OVERRIDE_TIME"] == 0.5

    taken = again(offered, restore_params=True)
    assert taken.problem() is not None
    taken.run(6.0)
    assert taken.problem() is None
    assert taken.values["RC_OVERRIDE_TIME"] == 3.0
    assert list(tmp_path.iterdir()) == []

    once_more = again(taken, restore_params=True)
    once_more.run(6.0)
    assert once_more.problem() is None
    assert told(once_more, "nothing is left over")


@pytest.mark.parametrize("value", [0.5, 0.7])
def test_the_value_from_before_a_crash_is_put_back_after_the_next_flight(
    tmp_path: Path, value: float
) -> None:
    crashed = start(tmp_path)
    crashed.run(6.0)
    later = again(crashed, set_params=(("RC_OVERRIDE_TIME", value),))
    later.run(6.0)
    assert later.problem() is None
    assert later.values["RC_OVERRIDE_TIME"] == value
    end(later)
    assert later.values["RC_OVERRIDE_TIME"] == 3.0
    assert list(tmp_path.iterdir()) == []


def test_a_crash_between_file_and_vehicle_loses_nothing(tmp_path: Path) -> None:
    crashed = start(tmp_path)
    crashed.run(6.0)
    second = again(crashed, set_params=(("RC_OVERRIDE_TIME", 0.7),))
    while not second.writes:
        second.step()
    second.values["RC_OVERRIDE_TIME"] = 0.5  # killed just before the packet left
    third = again(second, restore_params=True)
    third.run(6.0)
    assert third.values["RC_OVERRIDE_TIME"] == 3.0


@given(seed=st.integers(0, 2**32), steps=st.integers(0, 1200), is_ending=st.booleans())
@settings(max_examples=40)
def test_a_kill_at_any_moment_can_be_mended(seed: int, steps: int, is_ending: bool) -> None:
    with TemporaryDirectory() as folder:
        killed = start(Path(folder), loses=lossy(0.3, seed))
        killed.run(steps / 100)
        if is_ending:
            killed.params.begin_restore()
            killed.run((seed % 300) / 100)
        mended = again(killed, restore_params=True)
        mended.run(8.0)
        assert mended.problem() is None
        assert mended.values["RC_OVERRIDE_TIME"] == 3.0
        assert list(Path(folder).iterdir()) == []


def test_what_somebody_else_has_put_in_order_is_forgotten(tmp_path: Path) -> None:
    crashed = start(tmp_path)
    crashed.run(6.0)
    crashed.values["RC_OVERRIDE_TIME"] = 2.0
    later = again(crashed, restore_params=True)
    later.run(6.0)
    assert later.writes == []
    assert later.values["RC_OVERRIDE_TIME"] == 2.0
    assert not told(later, "left over from an earlier flight that")


def test_another_vehicle_of_the_same_system_id_has_a_file_of_its_own(tmp_path: Path) -> None:
    crashed = start(tmp_path)
    crashed.run(6.0)
    other = again(crashed, restore_params=True)
    other.unique_id = "cd34"
    other.run(6.0)
    assert other.writes == []
    assert "RC_OVERRIDE_TIME" in remembered(tmp_path)


@pytest.mark.parametrize(("then", "now"), [("", "ab12"), ("ab12", "")])
@pytest.mark.parametrize("flag", ["restore", "set"])
def test_a_leftover_is_found_although_the_unique_id_got_lost_once(
    then: str, now: str, flag: str, tmp_path: Path
) -> None:
    crashed = start(tmp_path)
    crashed.unique_id = then
    crashed.run(6.0)
    assert crashed.values["RC_OVERRIDE_TIME"] == 0.5
    more: dict[str, Any] = {"set_params": (("RC_OVERRIDE_TIME", 0.5),)}
    later = again(crashed, **(more if flag == "set" else {"restore_params": True}))
    later.unique_id = now
    later.run(6.0)
    assert later.problem() is None
    end(later)
    assert later.values["RC_OVERRIDE_TIME"] == 3.0
    assert list(tmp_path.iterdir()) == []


def test_what_another_vehicle_shows_does_not_take_a_leftover_without_an_id(tmp_path: Path) -> None:
    crashed = start(tmp_path)
    crashed.unique_id = ""
    crashed.run(6.0)
    before = (tmp_path / "vehicle-1.json").read_text()
    other = ParamVehicle({"RC_OVERRIDE_TIME": 1.0}, folder=tmp_path, restore_params=True)
    other.unique_id = "cd34"
    other.run(6.0)
    assert other.writes == []
    assert (tmp_path / "vehicle-1.json").read_text() == before


# --- the file


@pytest.mark.parametrize("content", ["", "[]", '{"parameters": {"A": 3}}', "\x00"])
def test_a_damaged_file_is_never_overwritten(tmp_path: Path, content: str) -> None:
    file = tmp_path / "vehicle-1-ab12.json"
    file.write_text(content)
    vehicle = start(tmp_path)
    vehicle.run(6.0)
    assert f"cannot read {file}" in str(vehicle.problem())
    end(vehicle)
    assert vehicle.writes == []
    assert file.read_text() == content
    bystander = again(vehicle)  # sets nothing: is told, and flies
    bystander.run(6.0)
    assert bystander.problem() is None
    assert told(bystander, "cannot read")


def test_nothing_is_set_that_cannot_be_remembered(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    vehicle = start(tmp_path / "file" / "state")
    vehicle.run(6.0)
    problem = str(vehicle.problem())
    assert "cannot re" in problem
    assert "vehicle-1-ab12.json" in problem
    assert vehicle.writes == []
    end(vehicle)
    assert vehicle.writes == []


def test_a_full_disk_forbids_the_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle = start(tmp_path)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("mavbridge.core.files.os.fsync", full)
    vehicle.run(6.0)
    assert "No space left on device" in str(vehicle.problem())
    assert vehicle.writes == []
