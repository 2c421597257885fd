"""Common part of both outputs for sticks: the policy's sticks and the vehicle's."""

from dataclasses import replace

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.vehicle import IDLE, Action, AdviceText, StickGains, Sticks, VehicleStatus
from mavbridge.mavlink.codec.packets import Codec, CommandRefusedError
from mavbridge.mavlink.outputs.echo import EchoRules
from mavbridge.mavlink.outputs.output import ActionOutput, Encoded
from mavbridge.mavlink.profiles.sticks import IDENTITY, StickCurves
from mavbridge.mavlink.session.vehicle import VehicleSession

_CURVES_NS = 500 * NS_PER_MS
"""Parameters that the curves depend on count after this time at the latest; a mode at once."""

_MOST_TOLD = 100
"""Notes: they name values of parameters, which may change any number of times."""


class StickOutput(ActionOutput):
    """Sticks, mapped so that they mean to the vehicle what they meant in the policy's training."""

    is_sticks = True

    def __init__(self, codec: Codec, rules: EchoRules, gains: StickGains | None) -> None:
        super().__init__(codec, rules)
        self._gains = gains
        """None: sticks go to the vehicle as they are."""
        self._curves = IDENTITY
        self._curves_mode = ""
        self._curves_due_ns = 0
        self._saturating: tuple[str, ...] = ()
        """Sticks of the last action that ask for more than the vehicle can do."""
        self._mapped: tuple[VehicleStatus, StickCurves, VehicleStatus] | None = None
        """A status of the vehicle, the curves, and what both come to in the policy's terms."""
        self._new_notes: list[str] = []
        self._told: set[str] = set()

    def restart(self) -> None:
        """A new session: its parameters and its mode count."""
        super().restart()
        self._curves_mode, self._curves_due_ns = "", 0

    def sent(self, encoded: Encoded, vehicle: VehicleSession, now_ns: int) -> None:
        """Note what has left."""
        super().sent(encoded, vehicle, now_ns)
        self.saturated.update(self._saturating)

    def take_notes(self) -> tuple[str, ...]:
        """What this vehicle cannot do that the policy may ask for, for the user; each once."""
        notes, self._new_notes = tuple(self._new_notes), []
        return notes

    def in_policy_terms(
        self, status: VehicleStatus | None, vehicle: VehicleSession, now_ns: int
    ) -> VehicleStatus | None:
        """The status with its sticks as the policy would mean them."""
        if self._gains is None or status is None:
            return status
        curves = self._curves_of(vehicle, status.mode, now_ns)
        if curves.is_identity or (status.rc_sticks is None and status.pilot_sticks is None):
            return status
        if self._mapped is None or self._mapped[0] is not status or self._mapped[1] is not curves:
            rc, pilot = status.rc_sticks, status.pilot_sticks
            told = replace(
                status,
                rc_sticks=None if rc is None else curves.to_policy(rc),
                pilot_sticks=None if pilot is None else curves.to_policy(pilot),
            )
            self._mapped = (status, curves, told)
        return self._mapped[2]

    def _resting(self, action: Action) -> Sticks:
        """The vehicle's sticks for an action, by the curves in use."""
        if not isinstance(action, Sticks):
            raise CommandRefusedError(f"{type(action).__name__} are not sticks")
        is_same = action is IDLE or self._curves.is_identity
        return action if is_same else self._curves.to_vehicle(action)

    def _wanted(
        self, action: Action, vehicle: VehicleSession, now_ns: int
    ) -> tuple[Sticks, StickCurves]:
        """The vehicle's sticks for an action, and the curves that lead back.

        ``IDLE`` is no motion that the policy means, but the stop at the bottom, for arming.
        """
        self._saturating = ()
        if not isinstance(action, Sticks):
            raise CommandRefusedError(f"{type(action).__name__} are not sticks")
        if self._gains is None or action is IDLE:
            return action, IDENTITY
        status = vehicle.status(now_ns)
        curves = self._curves_of(vehicle, status.mode if status else "", now_ns)
        if curves.is_identity:
            return action, curves
        self._saturating = curves.saturated(action)
        return curves.to_vehicle(action), curves

    def _curves_of(self, vehicle: VehicleSession, mode: str, now_ns: int) -> StickCurves:
        if mode != self._curves_mode or now_ns >= self._curves_due_ns:
            self._curves_mode, self._curves_due_ns = mode, now_ns + _CURVES_NS
            self._curves = vehicle.profile.stick_curves(vehicle.known_params, mode, self._gains)
            for note in self._curves.notes:
                is_new = note not in self._told and len(self._told) < _MOST_TOLD
                if is_new and vehicle.params.is_read:
                    self._told.add(note)
                    self._new_notes.append(AdviceText(note))
        return self._curves
