"""From the address of a vehicle to its rows: found, set up, measured, and perhaps tried."""

from contextlib import ExitStack
from dataclasses import replace

from mavbridge.commands.check.link_rows import echo_row, link_rows
from mavbridge.commands.check.param_rows import param_rows
from mavbridge.commands.check.policy import PolicyFindings
from mavbridge.commands.check.probe import VehicleProbe
from mavbridge.commands.check.rows import Row
from mavbridge.commands.check.terms import Terms
from mavbridge.commands.check.vehicle_rows import vehicle_rows
from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import Clock
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.vehicle import ActionMeaning
from mavbridge.flight.settings import action_meaning, gate_settings
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.settings import LinkSettings
from mavbridge.mavlink.transport.signing_files import SigningStore
from mavbridge.mavlink.transport.sockets import Transport, make_transport


def check_vehicle(
    config: FlyConfig,
    policy: PolicyFindings,
    clock: Clock,
    *,
    echo_test: bool,
    transport: Transport | None = None,
) -> list[Row]:
    """All rows about the link, the vehicle and its parameters; whatever fails is a row.

    ``transport`` replaces the one that the address of ``config`` names.
    """
    rows: list[Row] = []
    settings = checking_settings(config, policy, sends=echo_test)
    try:
        with ExitStack() as stack:
            transport = transport or make_transport(settings.connect, clock)
            signing = None
            if settings.signing is not None:
                signing = stack.enter_context(SigningStore(settings.signing, clock))
            link = MavlinkLink(transport, clock, settings, signing=signing)
            stack.callback(link.close)
            meaning = ActionMeaning()  # without a policy, sticks as they are
            if policy.contract is not None:
                meaning = action_meaning(policy.contract, config.link)
            output = None if config.link.output == "auto" else config.link.output
            link.begin_flight(meaning, output)
            probe = VehicleProbe(link, clock)
            probe.find()
            unfinished = probe.set_up()
            stats = probe.measure()
            vehicle, snapshot, texts = probe.find(), probe.snapshot(), list(probe.texts)
            terms = Terms.of(config, settings, policy.contract, vehicle, snapshot.status)
            rows += link_rows(vehicle, stats, terms, unfinished=unfinished)
            if echo_test:
                rows.append(echo_row(probe, terms))
            rows += vehicle_rows(vehicle, snapshot, terms, texts=texts)
            rows += param_rows(terms)
    except MavbridgeError as error:
        rows.append(_absent(error))
    return rows


def checking_settings(config: FlyConfig, policy: PolicyFindings, *, sends: bool) -> LinkSettings:
    """Settings of the flight's link, which sets no parameter and, unless ``sends``, no stick."""
    gate = gate_settings(config, is_dual=policy.is_dual, tlog_fd=None, wall_offset_ns=0)
    return replace(
        gate.link,
        readonly=not sends,
        set_params=(),
        restore_params=False,
        state_folder=None,
    )


def _absent(error: MavbridgeError) -> Row:
    return Row(
        area="link",
        name="vehicle",
        found="none that can be flown",
        expected="ArduCopter or a PX4 multicopter",
        verdict="no-go",
        advice=str(error),
    )
