"""The command: a usual flight whose policy is the scripted doublet, then the analysis."""

from dataclasses import replace

from mavbridge.commands.identify.analysis import identify_pushes
from mavbridge.commands.identify.config import IdentifyConfig
from mavbridge.commands.identify.recording import ResponseRecording
from mavbridge.commands.identify.results import print_identification, to_json
from mavbridge.commands.output import table_console
from mavbridge.config.flight import FlyConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock
from mavbridge.core.errors import PeerError, UserError
from mavbridge.core.files import require_writable
from mavbridge.flight.app import fly_executable
from mavbridge.flight.checks import check_flight
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policies import configured_contract
from mavbridge.observe.output import flight_console
from policy.contract import Contract
from policy.engines.executable import ExecutionSettings, make_numpy_executable
from policy.protocol import Executable
from policy.scripted import ScriptedPolicy
from policy.scripted.programs import doublet_length_s

CLIMB_S = 20.0
"""From the first action to the begin of the doublet, takeoff included."""


def identify(config: IdentifyConfig) -> int:
    """Fly the doublet, and say how the vehicle's gains and lags compare with the policy's.

    Raises:
        MavbridgeError: as for a flight; or it ended before anything could be measured.
    """
    clock = MonotonicClock()
    trained = configured_contract(config.flight.policy)
    flight = doublet_flight(config, trained)
    require_writable(config.json, "--json")
    check_flight(flight, clock)
    policy, executable = doublet_policy(trained, clock, is_in_air=flight.takeoff is not None)
    recording = ResponseRecording()
    plan = plan_flight(flight, executable.contract, is_dual=executable.dual_rate)
    fly_executable(plan, executable, clock=clock, console=flight_console(), sinks=(recording,))
    if policy.program_start_s is None:
        raise PeerError("the flight ended before the doublet began: there is nothing to measure")
    found = identify_pushes(recording, contract=trained, program_start_s=policy.program_start_s)
    if not found.pushes:
        raise PeerError(f"nothing could be measured: {'; '.join(found.missing)}")
    print_identification(found, trained, table_console())
    if config.json is not None:
        text = to_json(
            found, trained, policy=config.flight.policy.policy, is_mapped=config.mapped_sticks
        )
        config.json.write_text(text)
    return 0


def doublet_flight(config: IdentifyConfig, trained: Contract) -> FlyConfig:
    """The flight that the flags ask for, with the doublet instead of the policy.

    Raises:
        UserError: ``--readonly`` was given.
    """
    flight = config.flight
    if flight.link.readonly:
        raise UserError("identify has to move the vehicle: leave out --readonly")
    return replace(
        flight,
        policy=PolicyConfig(policy=f"scripted:doublet:{trained.action}", dual_rate=True),
        camera=replace(flight.camera, camera=("none",), window_name=None, camera_latency=0.0),
        link=replace(flight.link, raw_sticks=not config.mapped_sticks),
        duration=flight.duration or CLIMB_S + doublet_length_s(trained.action),
    )


def doublet_policy(
    trained: Contract, clock: Clock, *, is_in_air: bool
) -> tuple[ScriptedPolicy, Executable]:
    """The doublet in the policy's kind of action, and with what that policy means by it."""
    policy = ScriptedPolicy(
        "doublet",
        lambda: clock.now_ns() / NS_PER_S,
        action=trained.action,
        starts_in_air=is_in_air,
        contract=Contract(
            hover_thrust=trained.hover_thrust,
            full_lean_deg=trained.full_lean_deg,
            full_yaw_rate_degps=trained.full_yaw_rate_degps,
            full_climb_mps=trained.full_climb_mps,
            full_descent_mps=trained.full_descent_mps,
            lean_dead_zone=trained.lean_dead_zone,
            yaw_dead_zone=trained.yaw_dead_zone,
            throttle_dead_zone=trained.throttle_dead_zone,
        ),
    )
    executable = make_numpy_executable(policy, ExecutionSettings(name="scripted:doublet"))
    policy.reset()  # of what the trial on a dummy sample left behind
    return policy, replace(executable, reset=policy.reset)
