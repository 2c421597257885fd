"""Goal, height and altitude behind the state; the 13 numbers before them are test_state's."""

import numpy as np
import pytest

from mavbridge.config.flight import FlyConfig, LinkConfig
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import UserError
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import VehicleState
from mavbridge.core.vehicle import Reading, Telemetry
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.state import Freshness, StateReader
from policy.contract import Contract, StateExtra

MS = NS_PER_MS
NOW_NS = 5_000 * MS
FRESH = Freshness(attitude_ns=100 * MS, velocity_ns=250 * MS)
GOAL = (100.0, 20.0, -30.0)


def at(age_ms: int, *values: float) -> Reading:
    """A reading that happened so long ago, half of it on the way here."""
    return Reading(NOW_NS - age_ms * MS // 2, values, age_ms * MS - age_ms * MS // 2)


FLYING = Telemetry(
    ned_from_body_wxyz=at(4, 1, 0, 0, 0),
    rate_body_radps=at(4, 0, 0, 0),
    velocity_ned_mps=at(8, 1, 2, 3),
    specific_force_body_mps2=at(6, 0, 0, -9.8),
    position_ned_m=at(40, 10, 50, -12),
    height_above_home_m=at(60, 11.5),
)


def read(
    telemetry: Telemetry = FLYING,
    *extras: StateExtra,
    has_position: bool = True,
    **contract: object,
) -> VehicleState | Reason:
    asked = Contract(state_extras=extras, **contract)  # type: ignore[arg-type]
    reader = StateReader(asked, freshness=FRESH, goal_ned_m=GOAL)
    return reader.read(telemetry, NOW_NS, has_position=has_position)


@pytest.mark.parametrize(
    ("frame", "goal"), [("ned_frd", (90, -30, -18)), ("enu_flu", (-30, 90, 18))]
)
def test_extras_follow_in_the_contracts_order_and_axes(frame: str, goal: tuple[float, ...]) -> None:
    state = read(FLYING, "height", "goal", "altitude", state_frame=frame)
    assert isinstance(state, VehicleState)
    assert state.extras == (11.5, *goal, 12.0)
    assert state.extras_ns == NOW_NS - 60 * MS
    plain = read(FLYING, state_frame=frame)
    assert isinstance(plain, VehicleState)
    np.testing.assert_array_equal(state.values, plain.values)
    assert (plain.extras, plain.extras_ns) == ((), None)


@pytest.mark.parametrize(
    ("extra", "field"),
    [
        ("goal", "position_ned_m"),
        ("altitude", "position_ned_m"),
        ("height", "height_above_home_m"),
    ],
)
def test_what_is_missing_or_old_is_a_reason_and_never_a_zero(extra: StateExtra, field: str) -> None:
    what = "position" if field == "position_ned_m" else "height above home"
    reading = getattr(FLYING, field)
    missing = read(FLYING._replace(**{field: None}), extra)
    assert missing == because(Code.NO_TRUSTED_READING, quantity=what)
    just = FLYING._replace(**{field: at(250, *reading.values)})
    assert isinstance(read(just, extra), VehicleState)
    old = FLYING._replace(**{field: at(252, *reading.values)})
    assert read(old, extra) == because(Code.TOO_OLD, quantity=what, age_ms=252.0, limit_ms=250.0)
    assert isinstance(read(old), VehicleState)  # nobody asks for it


def test_a_state_that_is_missing_is_a_reason_also_where_extras_are_asked_for() -> None:
    refused = read(FLYING._replace(ned_from_body_wxyz=None), "height")
    assert refused == because(Code.NO_READING, quantity="attitude")


def test_a_contract_with_a_goal_is_not_flown_without_one() -> None:
    reader = StateReader(Contract(state_extras=("goal",)), freshness=FRESH)
    with pytest.raises(ValueError, match="takes a goal, and the flight has none"):
        reader.read(FLYING, NOW_NS, has_position=True)


def test_a_position_that_the_estimator_does_not_trust_is_none() -> None:
    for extra in ("goal", "altitude"):
        assert isinstance(read(FLYING, extra, has_position=False), Reason)  # type: ignore[arg-type]
    assert isinstance(read(FLYING, "height", has_position=False), VehicleState)


def config(goal: str | None) -> FlyConfig:
    return FlyConfig(link=LinkConfig(connect="udp:127.0.0.1:14550"), goal=goal)


def test_a_goal_is_given_just_where_the_policy_takes_one() -> None:
    def settings(goal: str | None, *extras: StateExtra) -> object:
        contract = Contract(state_extras=extras)
        return plan_flight(config(goal), contract, is_dual=True).guard

    assert config("-10.5, 2,-3").goal_ned_m == (-10.5, 2.0, -3.0)
    with pytest.raises(UserError, match="this policy flies to a goal: give --goal"):
        settings(None, "goal")
    with pytest.raises(UserError, match="takes no goal"):
        settings("1,2,3")
    for extras, height, position in (
        ((), False, False),
        (("height",), True, False),
        (("altitude",), False, True),
        (("goal", "height"), True, True),
    ):
        found = settings("1,2,3" if "goal" in extras else None, *extras)  # type: ignore[arg-type]
        assert found.watches_home_height is height  # type: ignore[attr-defined]
        assert found.watches_position is position  # type: ignore[attr-defined]
