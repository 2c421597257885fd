"""Facts of a vehicle that flies well, and an engagement stepped through them."""

from dataclasses import fields, replace
from typing import Any

from mavbridge.config.flight import FlyConfig, Limits, LinkConfig, SetpointLimits
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, Reason, Value, because
from mavbridge.core.vehicle import (
    NEUTRAL,
    ActionKind,
    ActionMeaning,
    LinkSnapshot,
    ModeRoles,
    Telemetry,
    VehicleStatus,
)
from mavbridge.flight.settings import action_limits
from mavbridge.guard.chunks import Chunk, FreshnessLimits
from mavbridge.guard.engagement import Engagement
from mavbridge.guard.envelope import EnvelopeLimits
from mavbridge.guard.limits import ActionLimits, Smoothing
from mavbridge.guard.values import (
    EndRequest,
    EngagementInputs,
    EngagementOutput,
    EngagementSettings,
    FlightSettings,
    OperatorCommand,
    Phase,
)

MODES = ("ALT_HOLD", "ALTCTL")
COPTER_MODES = ModeRoles(
    names=("STABILIZE", "ACRO", "ALT_HOLD", "LOITER", "BRAKE", "LAND", "RTL", "GUIDED"),
    hold="BRAKE",
    land="LAND",
    rtl="RTL",
    takeoff=("GUIDED",),
    thrust=("STABILIZE", "ACRO"),
    setpoint=("GUIDED", "GUIDED_NOGPS"),
)
PX4_MODES = ModeRoles(
    names=("ALTCTL", "POSCTL", "ACRO", "OFFBOARD", "AUTO.LOITER", "AUTO.LAND", "AUTO.RTL"),
    hold="AUTO.LOITER",
    land="AUTO.LAND",
    rtl="AUTO.RTL",
    takeoff=("AUTO.LOITER", "AUTO.TAKEOFF"),
    thrust=("MANUAL", "STABILIZED", "ACRO"),
    setpoint=("OFFBOARD",),
    needs_setpoints_first=True,
    is_silence_failsafe=True,
    override="POSCTL",
    needs_sticks_first=True,
)
STEP_NS = 10 * NS_PER_MS
FOREVER_NS = 2**62
"""``reset_ns`` of chunks for a guard that has to engage at once."""
LINK = LinkConfig(connect="memory")

_STATUS = VehicleStatus(
    mode="ALT_HOLD",
    armed=True,
    has_receiver=True,
    pilot_sticks=NEUTRAL,
    rc_channels_us=(1500,) * 8,
    is_position_valid=True,
    position_ned_m=(0.0, 0.0, -10.0),
    is_landed=False,
)
AIRBORNE = EngagementInputs(
    now_ns=0,
    link=LinkSnapshot(
        telemetry=Telemetry(),
        status=_STATUS,
        problem=None,
        modes=COPTER_MODES,
        echo_confirmed=True,
        is_released=False,
    ),
    chunk_problem=None,
    chunk_fault=None,
    is_policy_reset=True,
    envelope_problem=None,
)
"""Armed in ALT_HOLD, in the air, with a centred receiver and a policy within its limits."""


def altered(facts: EngagementInputs, **changes: Any) -> EngagementInputs:
    """Return the facts with other fields, those of the link and of the vehicle's status included.

    ``height_m`` changes the position.
    """
    if "height_m" in changes:
        height_m = changes.pop("height_m")
        changes["position_ned_m"] = None if height_m is None else (0.0, 0.0, -height_m)
    status, link = (
        {each.name: changes.pop(each.name) for each in fields(record) if each.name in changes}
        for record in (VehicleStatus, LinkSnapshot)
    )
    if status:
        link["status"] = replace(facts.status, **status)
    return replace(facts, link=replace(facts.link, **link), **changes)


ON_GROUND = altered(AIRBORNE, armed=False, echo_confirmed=False, height_m=0.0, is_landed=True)
NO_RECEIVER = altered(AIRBORNE, has_receiver=False, pilot_sticks=None)
IDLE_RECEIVER = altered(AIRBORNE, pilot_sticks=NEUTRAL._replace(throttle=-1.0))
FAULT = {"chunk_fault": because(Code.NO_CHUNK)}
DEATH = EndRequest(because(Code.FLIGHT_PROCESS_DIED), end="fault")


def stick_smoothing(
    *, max_slew_per_s: float = 0.0, tau_s: float = 0.0, max_dt_s: float = 0.15
) -> Smoothing:
    """Return a filter of sticks; without arguments it changes nothing."""
    config = FlyConfig(link=LINK, limits=Limits(max_slew=max_slew_per_s))
    limits = action_limits(config, "sticks")
    return Smoothing(limits=limits, tau_s=tau_s, max_dt_s=max_dt_s)


def limits_of(kind: ActionKind, **setpoints: float) -> ActionLimits:
    """Return the limits of a kind of action with these flags of the section setpoints."""
    return action_limits(FlyConfig(link=LINK, setpoints=SetpointLimits(**setpoints)), kind)


def engagement_settings(**settings: Any) -> EngagementSettings:
    """Return settings of the engagement; modes are ``MODES``."""
    return EngagementSettings(**{"modes": MODES, **settings})


def flight_settings(**changes: Any) -> FlightSettings:
    """Return settings for sticks at 100 Hz without a filter, in ALT_HOLD; ages up to 300 ms."""
    ages = dict.fromkeys(("state_ns", "velocity_ns", "feature_ns", "chunk_ns"), 300 * NS_PER_MS)
    settings: dict[str, Any] = {
        "meaning": ActionMeaning(),
        "stick_period_ns": 10 * NS_PER_MS,
        "chunk_period_ns": 10 * NS_PER_MS,
        "freshness": FreshnessLimits(**ages),
        "smoothing": stick_smoothing(),
        "envelope": EnvelopeLimits(),
        "watches_home_height": False,
        "watches_position": False,
        "engagement": engagement_settings(modes=("ALT_HOLD",)),
    }
    return FlightSettings(**(settings | changes))


def make_chunk(serial: int, solved_ns: int, *, age_ns: int = 0, **changes: Any) -> Chunk:
    """Return a chunk, 20 ms a step, for a guard that may engage at once.

    The vehicle's state is ``age_ns`` old at the end of the solve, the image 30 ms.
    """
    felt_ns = solved_ns - age_ns
    chunk = Chunk(
        serial=serial,
        attitude_ns=felt_ns,
        velocity_ns=felt_ns,
        image_ns=solved_ns - 30 * NS_PER_MS,
        computed_ns=solved_ns,
        first_ns=felt_ns,
        step_ns=20 * NS_PER_MS,
        actions=(NEUTRAL,) * 16,
        reset_ns=FOREVER_NS,
    )
    return chunk._replace(**changes)


def codes(reason: Reason | None) -> tuple[Code, ...]:
    """Return the codes of a reason; none while the policy flies."""
    return () if reason is None else reason.codes


def figures(reason: Reason | None, code: Code) -> dict[str, Value]:
    """Return the figures of the reason with this code, inner reasons included, or none."""
    if reason is None:
        return {}
    if reason.code is code:
        return dict(reason.data)
    inner = (figures(value, code) for _, value in reason.data if isinstance(value, Reason))
    return next(filter(None, inner), {})


class Stepped:
    """An engagement, its facts, and all of its decisions."""

    def __init__(self, facts: EngagementInputs = AIRBORNE, **settings: Any) -> None:
        self.engagement = Engagement(engagement_settings(**settings))
        self.facts = facts
        self.moves: list[EngagementOutput] = []

    def step(
        self, act: OperatorCommand | None = None, *, stop: EndRequest | None = None, **changes: Any
    ) -> EngagementOutput:
        """Step once, 10 ms after the last; changes of the facts persist."""
        if stop is not None:
            self.engagement.stop(stop)
        if changes.get("interruption") is not None:
            changes.setdefault("interruptions", self.facts.link.interruptions + 1)
        self.facts = altered(self.facts, now_ns=self.facts.now_ns + STEP_NS, **changes)
        self.moves.append(self.engagement.step(self.facts, act))
        return self.moves[-1]

    def run(self, seconds: float, **changes: Any) -> list[EngagementOutput]:
        """Step for a while; return the decisions."""
        start = len(self.moves)
        for _ in range(round(seconds * 100)):
            self.step(**changes)
        return self.moves[start:]

    @property
    def phase(self) -> Phase:
        return self.engagement.phase

    @property
    def codes(self) -> tuple[Code, ...]:
        return codes(self.engagement.reason)


def flying(facts: EngagementInputs = AIRBORNE, **settings: Any) -> Stepped:
    """Return an engagement engaged by the operator's key."""
    stepped = Stepped(facts, **settings)
    stepped.step()
    stepped.step("engage")
    assert stepped.phase is Phase.FLYING, stepped.engagement.refusal
    return stepped
