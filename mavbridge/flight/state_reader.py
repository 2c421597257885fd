"""Telemetry -> all numbers of the state that a contract asks for, or the reason why there are none.

Freshness of the extra inputs is that of the velocity: a missing or an old one is a refusal.
"""

from dataclasses import replace

from mavbridge.core.reasons import Code, because
from mavbridge.core.records import VehicleState
from mavbridge.core.vehicle import Reading, Telemetry
from mavbridge.flight.state import Freshness, Unavailable, build_state, stale
from policy.contract import Contract

Ned = tuple[float, float, float]
_READINGS = {"goal": "position", "altitude": "position", "height": "height above home"}


class StateReader:
    """Reads the states of one flight."""

    def __init__(
        self, contract: Contract, *, freshness: Freshness, goal_ned_m: Ned | None = None
    ) -> None:
        """``goal_ned_m``: from the estimator's origin, for a contract that asks for it."""
        self._frame = contract.state_frame
        self._extras = contract.state_extras
        self._freshness = freshness
        self._goal_ned_m = goal_ned_m

    def read(
        self, telemetry: Telemetry, now_ns: int, *, has_position: bool
    ) -> VehicleState | Unavailable:
        """The state of now; ``has_position``: the vehicle's position may be trusted."""
        state = build_state(telemetry, now_ns, frame=self._frame, freshness=self._freshness)
        if isinstance(state, Unavailable) or not self._extras:
            return state
        position = telemetry.position_ned_m if has_position else None
        numbers: list[float] = []
        stamps_ns: list[int] = []
        for extra in self._extras:
            reading = telemetry.height_above_home_m if extra == "height" else position
            if reading is None or not reading.is_fresh(now_ns, self._freshness.velocity_ns):
                return self._missing(extra, reading, now_ns)
            stamps_ns.append(reading.happened_ns)
            if extra == "goal":
                numbers += self._to_goal(reading.values)
            else:
                numbers.append(reading.values[0] if extra == "height" else -reading.values[2])
        return replace(state, extras=tuple(numbers), extras_ns=min(stamps_ns))

    def _missing(self, extra: str, reading: Reading | None, now_ns: int) -> Unavailable:
        what = _READINGS[extra]
        if reading is None:
            return Unavailable(because(Code.NO_TRUSTED_READING, quantity=what))
        return stale(reading, what, now_ns, self._freshness.velocity_ns)

    def _to_goal(self, position_ned_m: tuple[float, ...]) -> list[float]:
        """From the vehicle to the goal, in the world's axes of the contract."""
        if self._goal_ned_m is None:
            raise ValueError("the contract takes a goal, and the flight has none")
        north, east, down = (
            there - here for there, here in zip(self._goal_ned_m, position_ned_m, strict=True)
        )
        return [north, east, down] if self._frame == "ned_frd" else [east, north, -down]
