"""How the vehicle's record tells the end of a flight."""

import pytest

from faults.record import Ending, StickEntry, VehicleReport, ending


def entry(t_s: float, height_m: float, mode: str = "BRAKE") -> StickEntry:
    return StickEntry(
        t_s=t_s,
        us=(1500, 1500, 1500, 1500),
        mode=mode,
        armed=True,
        failsafe=False,
        lean_deg=0.0,
        climb_mps=0.0,
        height_m=height_m,
    )


def report(*sticks: StickEntry, impact_mps: float = 0.0) -> VehicleReport:
    return VehicleReport(
        start_ns=0,
        sticks=sticks,
        refused_messages=0,
        crashed=False,
        armed_s=1.0,
        max_altitude_m=9.0,
        impact_speed_mps=impact_mps,
        final={"mode": "LOITER", "armed": True, "landed": False},
    )


@pytest.mark.parametrize(
    ("heights_m", "lost_m"),
    [((5.0, 5.5, 6.0), 0.0), ((5.0, 3.5, 4.0), 1.5), ((5.0, 6.0, 4.0), 1.0)],
)
def test_the_height_lost_is_that_of_the_lowest_point(
    heights_m: tuple[float, ...], lost_m: float
) -> None:
    sticks = [entry(1.0 + k, height_m) for k, height_m in enumerate(heights_m)]
    found = ending(report(entry(0.5, 9.0), *sticks, entry(9.0, 0.0)), since_s=1.0, until_s=9.0)
    assert found == Ending(mode="BRAKE", lost_m=lost_m, impact_mps=0.0)


def test_a_landing_loses_no_height_and_reports_its_touchdown() -> None:
    sticks = (entry(1.0, 5.0), entry(1.1, 4.8), entry(1.2, 4.8, "LAND"), entry(9.0, 0.0, "LAND"))
    found = ending(report(*sticks, impact_mps=0.5), since_s=1.0, until_s=99.0)
    assert found.mode == "LAND"
    assert found.lost_m == pytest.approx(0.2)
    assert found.impact_mps == 0.5


def test_without_an_entry_after_the_end_the_final_mode_counts() -> None:
    assert ending(report(entry(1.0, 5.0)), 2.0, 9.0) == Ending("LOITER", 0.0, 0.0)
