"""What the flags and the contract tell the guard."""

from dataclasses import replace

import pytest

from mavbridge.config.flight import EnvelopeConfig, FlyConfig, Limits, LinkConfig
from mavbridge.config.rates import Rates
from mavbridge.core.errors import UserError
from mavbridge.core.vehicle import ActionMeaning, StickGains
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.settings import action_meaning, guard_settings
from mavbridge.guard.memory import EngagementSettings
from mavbridge.guard.sequences import DisengageSettings, EngageSettings
from mavbridge.guard.settings import FlightSettings
from policy.contract import Contract

LINK = LinkConfig(connect="udp:127.0.0.1:14550")


def settings_for(
    config: FlyConfig | None = None, contract: Contract | None = None, *, dual_rate: bool = True
) -> FlightSettings:
    contract = contract or Contract(feature_dim=8)
    return plan_flight(config or FlyConfig(link=LINK), contract, is_dual=dual_rate).guard


def test_the_process_is_told_what_the_flags_say() -> None:
    config = FlyConfig(
        link=replace(LINK, source_system=254),
        rates=Rates(stick_rate=250.0, realtime=False, guard_cpu=1),
        envelope=EnvelopeConfig(min_battery=25.0),
    )
    settings = guard_settings(config, is_dual=True, tlog_fd=7, wall_offset_ns=5)
    link = settings.link
    assert (link.connect, link.source_system) == ("udp:127.0.0.1:14550", 254)
    assert (link.state_hz, link.stick_hz, link.min_battery_percent) == (100.0, 350.0, 25.0)
    assert (settings.realtime, settings.cpu) == (False, 1)
    assert (settings.tlog_fd, settings.wall_offset_ns) == (7, 5)


@pytest.mark.parametrize(
    ("dual_rate", "chunk_period_ns"), [(True, 20_000_000), (False, 50_000_000)]
)
def test_periods_follow_the_rates(dual_rate: bool, chunk_period_ns: int) -> None:
    rates = Rates(stick_rate=400.0, action_rate=50.0, rate=20.0)
    settings = settings_for(FlyConfig(link=LINK, rates=rates), dual_rate=dual_rate)
    assert settings.stick_period_ns == 2_500_000
    assert settings.chunk_period_ns == chunk_period_ns


def test_ages_are_those_of_the_contract_and_a_flag_may_tighten_them() -> None:
    contract = Contract(feature_dim=8, max_state_age_s=0.5, max_chunk_age_s=2.0)
    loose = settings_for(contract=contract).freshness
    assert (loose.state_ns, loose.velocity_ns) == (500_000_000, 250_000_000)
    assert (loose.feature_ns, loose.chunk_ns) == (300_000_000, 2_000_000_000)
    config = FlyConfig(link=LINK, limits=Limits(max_attitude_age=0.05))
    assert settings_for(config, contract).freshness == replace(loose, state_ns=50_000_000)
    with pytest.raises(UserError, match="looser than"):
        settings_for(FlyConfig(link=LINK, limits=Limits(max_chunk_age=2.1)), contract)


def test_smoothing_is_that_of_the_flags() -> None:
    smoothing = settings_for(FlyConfig(link=LINK, limits=Limits(tau=0.1, max_slew=3.0))).smoothing
    assert (smoothing.tau_s, smoothing.limits.change_per_s) == (0.1, (3.0,) * 4)


@pytest.mark.parametrize(
    ("contract_deg", "flag_deg", "limit_deg"),
    [
        (None, None, 60.0),  # the default
        (80.0, None, 80.0),  # widened by the contract
        (30.0, None, 60.0),  # which does not narrow it
        (None, 45.0, 45.0),
        (80.0, 45.0, 45.0),  # the flag has the last word
        (80.0, 0.0, 0.0),
    ],
)
def test_the_envelope_is_widened_by_the_contract_and_set_by_the_flag(
    contract_deg: float | None, flag_deg: float | None, limit_deg: float
) -> None:
    config = FlyConfig(link=LINK, envelope=EnvelopeConfig(max_tilt=flag_deg))
    contract = Contract(feature_dim=8, max_tilt_deg=contract_deg)
    envelope = settings_for(config, contract).envelope
    assert envelope.tilt_deg == limit_deg
    assert (envelope.height_m, envelope.speed_mps, envelope.distance_m) == (120.0, 20.0, 300.0)
    assert envelope.estimator
    assert envelope.battery
    assert envelope.landing


def test_engaging_and_leaving_follow_the_flags() -> None:
    config = FlyConfig(
        link=replace(LINK, output="manual-control"),
        arm=True,
        mode="altctl",
        engage_channel=8,
        engage_on_arm=True,
        on_fault="rtl",
        then="hold",
        duration=1.5,
    )
    assert settings_for(config).engagement == EngagementSettings(
        engage=EngageSettings(modes=("ALT_HOLD", "ALTCTL"), mode="ALTCTL"),
        arm=True,
        engage_channel=8,
        engage_on_arm=True,
        duration_ns=1_500_000_000,
        disengage=DisengageSettings(on_fault="rtl", then="hold"),
    )
    assert settings_for(FlyConfig(link=replace(LINK, readonly=True))).engagement.readonly


@pytest.mark.parametrize("mode", ["RTL", "GUIDED", "STABILIZE", "alt hold"])
def test_a_mode_in_which_the_policy_does_not_fly_is_refused(mode: str) -> None:
    with pytest.raises(UserError, match=r"flies in ALT_HOLD or ALTCTL only"):
        settings_for(FlyConfig(link=LINK, mode=mode))


def test_the_contract_says_what_full_stick_means_and_raw_sticks_says_nothing() -> None:
    contract = Contract(
        full_lean_deg=45.0,
        full_yaw_rate_degps=100.0,
        full_climb_mps=3.0,
        full_descent_mps=1.5,
        lean_dead_zone=0.01,
        yaw_dead_zone=0.02,
        throttle_dead_zone=0.03,
    )
    gains = StickGains(
        lean_deg=45.0,
        yaw_rate_degps=100.0,
        climb_mps=3.0,
        descent_mps=1.5,
        lean_dead_zone=0.01,
        yaw_dead_zone=0.02,
        throttle_dead_zone=0.03,
    )
    assert action_meaning(contract, LINK) == ActionMeaning(stick_gains=gains)
    assert action_meaning(contract, replace(LINK, raw_sticks=True)) == ActionMeaning()


def test_other_actions_than_sticks_have_no_gains() -> None:
    contract = Contract(action="velocity", velocity_frame="heading", hover_thrust=0.5)
    assert action_meaning(contract, LINK) == ActionMeaning(
        kind="velocity", hover_thrust=0.5, is_heading_frame=True
    )
