"""The terms of the flight that is checked, and the judgement that it makes of the parameters."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

from mavbridge.commands.check.rows import Verdict
from mavbridge.config.flight import FlyConfig
from mavbridge.core.address import serial_baud
from mavbridge.core.vehicle import ActionKind, StickGains, VehicleStatus
from mavbridge.flight.settings import action_meaning
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.profiles.profile import Danger, ParamContext, Profile, StreamGroup
from mavbridge.mavlink.session.params.bandwidth import baud_danger
from mavbridge.mavlink.session.params.checks import assess
from mavbridge.mavlink.session.vehicle import VehicleSession
from mavbridge.mavlink.settings import LinkSettings
from policy.contract import Contract

_STICK_OUTPUTS = ("rc-override", "manual-control")


class Sentence(NamedTuple):
    """What a flight would say of the parameters."""

    verdict: Verdict
    text: str


@dataclass(frozen=True, kw_only=True)
class Terms:
    """One vehicle, and the flight that is meant for it."""

    config: FlyConfig
    settings: LinkSettings
    contract: Contract | None
    """None: no policy."""
    profile: Profile
    read: Mapping[str, float]
    """Parameters of the vehicle."""
    context: ParamContext

    @classmethod
    def of(
        cls,
        config: FlyConfig,
        settings: LinkSettings,
        contract: Contract | None,
        vehicle: VehicleSession,
        status: VehicleStatus | None,
    ) -> "Terms":
        """Terms by what the vehicle has told so far."""
        kind: ActionKind = "sticks" if contract is None else contract.action
        output = config.link.output
        usual = vehicle.profile.outputs[kind]
        return cls(
            config=config,
            settings=settings,
            contract=contract,
            profile=vehicle.profile,
            read=vehicle.known_params,
            context=ParamContext(
                usual if output == "auto" else output,
                config.link.source_system,
                status.has_receiver if status else None,
            ),
        )

    @property
    def values(self) -> dict[str, float]:
        """Parameters as the flight would have them: with those of --set."""
        return dict(self.read) | dict(self.config.link.set_params)

    @property
    def is_sticks(self) -> bool:
        """The actions are sticks, and not setpoints."""
        return self.context.output in _STICK_OUTPUTS

    @property
    def gains(self) -> StickGains | None:
        """What full stick means to the policy; None where there is none of sticks."""
        if self.contract is None:
            return None
        link = replace(self.config.link, raw_sticks=False)
        return action_meaning(self.contract, link).stick_gains

    @property
    def mode(self) -> str | None:
        """The mode of the flight; None if it is not known, or the vehicle lacks it."""
        if self.config.mode is not None:
            wanted: tuple[str, ...] = (self.config.mode.upper(),)
        else:
            wanted = () if self.contract is None else self.contract.modes
        names = self.profile.modes.roles.names
        return next((mode for mode in wanted if mode in names), None)

    @property
    def streams(self) -> tuple[StreamGroup, ...]:
        """Telemetry that the flight asks for."""
        return self.profile.streams(state_hz=self.settings.state_hz)

    @property
    def calibration(self) -> RcCalibration | None:
        """The radio calibration by which sticks would be sent."""
        return assess(self.profile, self.values, self.context).calibration

    def sentences(self) -> Iterator[Sentence]:
        """Refusals and warnings of the flight, and hints that only a check gives."""
        values, context = self.values, self.context
        assessment = assess(self.profile, values, context)
        yield from (Sentence("no-go", text) for text in assessment.obstacles)
        if assessment.unusable is not None:
            yield Sentence("no-go", assessment.unusable)
        serial = baud_danger(
            serial_baud(self.settings.connect),
            streams=self.streams,
            stick_hz=self.settings.stick_hz,
        )
        dangers = (*([Danger("slow-serial", serial)] if serial else []), *assessment.dangers)
        for danger in dangers:
            if danger.risk in self.config.link.accept_risk:
                yield Sentence("warn", f"risk {danger.risk} is accepted: {danger.text}")
            else:
                yield Sentence("no-go", danger.refusal)
        yield from (Sentence("warn", text) for text in self.profile.advice(values, context))
        yield from (Sentence("warn", text) for text in self.profile.hints(values, context))
