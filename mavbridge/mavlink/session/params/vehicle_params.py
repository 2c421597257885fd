"""All that the bridge knows, demands and changes of one vehicle's parameters."""

from collections.abc import Callable, Iterator, Mapping

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import PeerError
from mavbridge.core.vehicle import VehicleStatus
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import ParamRequest, ParamValue, ParamWrite
from mavbridge.mavlink.session.discovery import VehicleIdentity
from mavbridge.mavlink.session.params.bandwidth import baud_danger
from mavbridge.mavlink.session.params.checks import Assessment, Danger, advice, assess
from mavbridge.mavlink.session.params.reader import (
    FIRST_NAMES,
    RISK_NAMES,
    ParamReader,
    calibration_names,
    dead_zone_names,
)
from mavbridge.mavlink.session.params.temporary import TemporaryParams
from mavbridge.mavlink.session.streams import StreamGroup
from mavbridge.mavlink.settings import LinkSettings
from mavbridge.mavlink.transport.sockets import serial_baud

_AGAIN_NS = 2 * NS_PER_S
"""Between attempts to read parameters that the vehicle did not send."""


class VehicleParams:
    """Reads the parameters, sets some for the flight, and says why they forbid one.

    Values heard later, whoever has changed them, count at once for ``problem``. The calibration
    follows while the vehicle is disarmed; a change in flight that matters is an interruption.

    Raises:
        PeerError: parameters are to be set on a vehicle that is not ArduPilot.
    """

    def __init__(
        self,
        identity: VehicleIdentity,
        config: LinkSettings,
        *,
        streams: tuple[StreamGroup, ...],
        report: Callable[[str], None],
    ) -> None:
        self._is_override = identity.autopilot == "ardupilot"
        changes_any = bool(config.set_params or config.restore_params)
        if changes_any and identity.autopilot != "ardupilot":
            raise PeerError(
                f"--set and --restore-params are for ArduPilot, and this is {identity.autopilot}: "
                "set its parameters with your ground station"
            )
        self._config = config
        self._report = report
        self._system = identity.source.system
        self._serial = baud_danger(
            serial_baud(config.connect), streams=streams, stick_hz=config.stick_hz
        )
        self._reader = ParamReader(FIRST_NAMES if self._is_override else ())
        self._has_asked_channels = False
        self._again_ns = 0
        self._changes = TemporaryParams(
            config.set_params,
            restores_leftovers=config.restore_params,
            folder=config.state_folder if self._is_override else None,
            report=report,
        )
        self._has_advised = False
        self._assessed: tuple[bool | None, Assessment] | None = None
        """The receiver, if any, and what follows from that and all values."""
        self.is_read = not self._is_override
        """Every parameter has come or was given up."""
        self.calibration: RcCalibration | None = None
        """The calibration to fly with; None before it is read, or if it cannot be used."""
        self.interruption: str | None = None
        """A change in flight that ends every engagement so far, or None; stays once set."""

    @property
    def values(self) -> Mapping[str, float]:
        """All parameters that matter and that the vehicle has sent, by name."""
        return dict(sorted(self._reader.values.items()))

    @property
    def override_switch(self) -> int | None:
        """Number of the channel that enables overrides, or None."""
        return self._assessed[1].override_switch if self._assessed else None

    def receive(self, param: ParamValue, status: VehicleStatus | None) -> None:
        """Take a PARAM_VALUE, requested or not."""
        old = self._reader.values.get(param.name)
        self._reader.receive(param)
        self._changes.receive(param)
        if not self.is_read or old == self._reader.values.get(param.name):
            return
        before, after = self._assessed, self._assess(status)
        is_armed = status is not None and status.armed
        if not is_armed or old is None or before is None:
            return
        if after.endangers(before[1], accepted=self._config.accepted_risks):
            self.interruption = (
                f"{param.name} was changed from {old:g} to {param.value:g} in flight"
            )

    def _assess(self, status: VehicleStatus | None) -> Assessment:
        has_receiver = None if status is None else status.has_receiver
        assessment = assess(
            self._reader.values,
            source_system=self._config.source_system,
            has_receiver=has_receiver,
        )
        self._assessed = (has_receiver, assessment)
        return assessment

    def step(
        self, now_ns: int, status: VehicleStatus | None, *, unique_id: str | None
    ) -> Iterator[ParamRequest | ParamWrite]:
        """Requests that are due.

        ``unique_id`` is the autopilot's own, empty if it has none, and None while it is not known.
        """
        if self._changes.is_opening and unique_id is not None:
            name = f"vehicle-{self._system}-{unique_id}" if unique_id else f"vehicle-{self._system}"
            self._reader.request(self._changes.open(name))
        yield from self._reader.step(now_ns)
        if self._is_override and self._reader.is_done:
            self._ask_for_missing(now_ns, status)
        if self._reader.is_done:
            self._take_in(status)
            self._advise()
        if self.is_read:
            yield from self._changes.step(
                now_ns,
                self._reader.values,
                is_complete=self._reader.is_done,
                is_disarmed=status is not None and not status.armed,
            )

    def _ask_for_missing(self, now_ns: int, status: VehicleStatus | None) -> None:
        """Ask for the stick channels once RCMAP_* is known, and on the ground for what got lost."""
        is_flying = self.calibration is not None and status is not None and status.armed
        if now_ns < self._again_ns or is_flying:
            return
        self._again_ns = now_ns + _AGAIN_NS
        values = self._reader.values
        names = (*calibration_names(values), *RISK_NAMES)
        if not self._has_asked_channels or any(name not in values for name in names):
            self._has_asked_channels = True
            self._reader.request((*names, *dead_zone_names(values)))

    def _take_in(self, status: VehicleStatus | None) -> None:
        """Fly with what was read, from the beginning or from the next time on the ground."""
        if not self._is_override:
            return
        self.is_read = True
        assessment = self._assessed[1] if self._assessed else self._assess(status)
        if assessment.calibration == self.calibration:
            return
        is_armed = status is not None and status.armed
        if self.calibration is None or not is_armed:
            if self.calibration is not None and assessment.calibration is not None:
                self._report("the vehicle's radio calibration has changed: the new one counts")
            self.calibration = assessment.calibration

    def _advise(self) -> None:
        if self._has_advised or not self.is_read or not self._changes.is_settled:
            return
        self._has_advised = True
        for text in advice(self._reader.values) if self._is_override else ():
            self._report(text)
        for danger in self._dangers():
            if danger.risk in self._config.accepted_risks:
                self._report(f"risk {danger.risk} is accepted: {danger.text}")

    def _dangers(self) -> Iterator[Danger]:
        if self._serial is not None:
            yield Danger("slow-serial", self._serial)
        if self._assessed is not None:
            yield from self._assessed[1].dangers

    def problem(self, status: VehicleStatus | None) -> str | None:
        """Why a flight may not begin or go on with these parameters, or None."""
        if not self.is_read:
            return "reading the vehicle's parameters"
        if (waiting := self._changes.problem()) is not None:
            return waiting
        if self._is_override and (forbidden := self._forbidden(status)) is not None:
            return forbidden
        accepted = self._config.accepted_risks
        return next((d.refusal for d in self._dangers() if d.risk not in accepted), None)

    def _forbidden(self, status: VehicleStatus | None) -> str | None:
        """Problems that nobody can accept: sticks that would not arrive, or mean something else."""
        has_receiver = None if status is None else status.has_receiver
        if self._assessed is None or self._assessed[0] != has_receiver:
            self._assess(status)
        assert self._assessed is not None
        assessment = self._assessed[1]
        if assessment.obstacles:
            return f"the vehicle would ignore our sticks: {'; '.join(assessment.obstacles)}"
        if assessment.unusable is not None:
            return assessment.unusable
        if assessment.calibration != self.calibration:
            return "the vehicle's radio calibration was changed in flight: disarm to take it in"
        return None

    def begin_restore(self) -> None:
        """Put back what was set for the flight; ``is_restored`` tells when that is done."""
        self._changes.begin_restore()

    @property
    def is_restored(self) -> bool:
        """The end has been begun and nothing more can be done now."""
        return self._changes.is_restored
