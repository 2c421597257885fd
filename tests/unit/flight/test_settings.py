"""What the flags and the contract tell the guard."""

from dataclasses import replace
from pathlib import Path

import pytest

from mavbridge.config.flight import EnvelopeConfig, FlyConfig, Limits, LinkConfig
from mavbridge.config.policy import Rates
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import UserError
from mavbridge.core.vehicle import ActionMeaning, StickGains
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.settings import (
    action_meaning,
    contract_with_ages,
    effective_freshness,
    link_settings,
    state_folder,
)
from mavbridge.guard.chunks import FreshnessLimits
from mavbridge.guard.values import EngagementSettings, FlightSettings
from policy.contract import Contract

LINK = LinkConfig(connect="udp:127.0.0.1:14550")


def settings_for(
    config: FlyConfig | None = None, contract: Contract | None = None, *, dual_rate: bool = True
) -> FlightSettings:
    contract = contract or Contract(feature_dim=8)
    return plan_flight(config or FlyConfig(link=LINK), contract, is_dual=dual_rate).guard


def test_the_process_is_told_what_the_flags_say() -> None:
    sets = ("rc_override_time=0.5", "FS_THR_ENABLE=1")
    config = FlyConfig(
        link=replace(LINK, source_system=254, set=sets, accept_risk=("slow-serial",)),
        rates=Rates(stick_rate=250.0, realtime=False),
        envelope=EnvelopeConfig(min_battery=25.0),
    )
    link = link_settings(config, config.rates.loops(is_dual=True))
    assert (link.connect, link.source_system) == ("udp:127.0.0.1:14550", 254)
    assert (link.state_hz, link.stick_hz, link.min_battery_percent) == (100.0, 350.0, 25.0)
    assert link.set_params == (("RC_OVERRIDE_TIME", 0.5), ("FS_THR_ENABLE", 1.0))
    assert link.accepted_risks == ("slow-serial",)


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


def test_rates_smoothing_and_the_ways_in_and_out_follow_the_flags() -> None:
    config = FlyConfig(
        link=replace(LINK, output="manual-control"),
        rates=Rates(stick_rate=400.0, action_rate=50.0, rate=20.0),
        limits=Limits(tau=0.1, max_slew=3.0),
        arm=True,
        mode="altctl",
        engage_channel=8,
        engage_on_arm=True,
        on_fault="rtl",
        then="hold",
        duration=1.5,
    )
    settings = settings_for(config)
    assert (settings.stick_period_ns, settings.chunk_period_ns) == (2_500_000, 20_000_000)
    assert settings_for(config, dual_rate=False).chunk_period_ns == 50_000_000
    assert (settings.smoothing.tau_s, settings.smoothing.limits.change_per_s) == (0.1, (3.0,) * 4)
    assert settings.engagement == EngagementSettings(
        modes=("ALT_HOLD", "ALTCTL"),
        mode="ALTCTL",
        arm=True,
        engage_channel=8,
        engage_on_arm=True,
        duration_ns=1_500_000_000,
        on_fault="rtl",
        then="hold",
    )
    assert settings_for(FlyConfig(link=replace(LINK, readonly=True))).engagement.readonly


@pytest.mark.parametrize("mode", ["RTL", "GUIDED", "STABILIZE", "alt hold"])
def test_a_mode_in_which_the_policy_does_not_fly_is_refused(mode: str) -> None:
    with pytest.raises(UserError, match=r"flies in ALT_HOLD or ALTCTL only"):
        settings_for(FlyConfig(link=LINK, mode=mode))


@pytest.mark.parametrize(
    "flags",
    [
        *(("A",), ("A=",), ("A=fast",), ("A=nan",), ("A=1e39",), ("../A=1",)),
        ("A_NAME_THAT_IS_TOO_LONG=1",),
        ("A=1", "a=2"),
        ("rcmap_yaw=5",),
    ],
)
def test_a_parameter_that_cannot_be_set_is_refused(flags: tuple[str, ...]) -> None:
    with pytest.raises(UserError, match=r"NAME=VALUE|names A twice|next boot"):
        LinkConfig(set=flags)


def test_a_readonly_flight_sets_no_parameter() -> None:
    with pytest.raises(UserError, match="--readonly sets no parameter"):
        LinkConfig(set=("A=1",), readonly=True)


@pytest.mark.parametrize("goal", ["1,2", "1,2,3,4", "", "a,b,c", "1,nan,0", "0,inf,0", "1e6,0,0"])
def test_a_goal_that_cannot_be_is_refused(goal: str) -> None:
    with pytest.raises(UserError, match="use NORTH,EAST,DOWN in metres"):
        FlyConfig(link=LINK, goal=goal)


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


# --- ages

AGED = Contract(
    max_state_age_s=0.2,
    max_velocity_age_s=0.4,
    max_feature_age_s=2,
    max_chunk_age_s=1.5,
    max_stall_s=0.5,
)


def in_ms(*state_velocity_feature_chunk_stall: int) -> FreshnessLimits:
    names = ("state_ns", "velocity_ns", "feature_ns", "chunk_ns", "stall_ns")
    given = zip(names, state_velocity_feature_chunk_stall, strict=True)
    return FreshnessLimits(**{name: ms * NS_PER_MS for name, ms in given})


@pytest.mark.parametrize(
    ("contract", "limits", "expected"),
    [
        (AGED, Limits(), in_ms(200, 400, 2000, 1500, 500)),
        (Contract(), Limits(), in_ms(100, 250, 300, 300, 250)),
        (AGED, Limits(max_attitude_age=0.05, max_chunk_age=1.5), in_ms(50, 400, 2000, 1500, 500)),
        (
            AGED,
            Limits(max_velocity_age=0.3, max_feature_age=0.25, max_stall=0.2),
            in_ms(200, 300, 250, 1500, 200),
        ),
    ],
)
def test_ages_are_the_contracts_and_flags_tighten_one_by_one(
    contract: Contract, limits: Limits, expected: FreshnessLimits
) -> None:
    assert effective_freshness(contract, limits) == expected


@pytest.mark.parametrize(
    ("name", "asked_s", "allowed_s"),
    [
        ("attitude_age", 0.25, 0.2),
        ("velocity_age", 0.5, 0.4),
        ("feature_age", 5, 2),
        ("chunk_age", 1.6, 1.5),
        ("stall", 0.6, 0.5),
    ],
)
def test_a_flag_that_would_loosen_is_refused(name: str, asked_s: float, allowed_s: float) -> None:
    limits = Limits(**{f"max_{name}": asked_s})
    with pytest.raises(UserError, match=f"limits.{name}={asked_s} is looser than the {allowed_s}"):
        settings_for(FlyConfig(link=LINK, limits=limits), AGED)
    allowed = effective_freshness(contract_with_ages(AGED, limits), limits)
    assert allowed != effective_freshness(AGED, Limits())


def test_the_state_folder_follows_the_users_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert state_folder() == tmp_path / "mavbridge"
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for value in ("", "not/absolute"):
        monkeypatch.setenv("XDG_STATE_HOME", value)
        assert state_folder() == tmp_path / "home" / ".local" / "state" / "mavbridge"
