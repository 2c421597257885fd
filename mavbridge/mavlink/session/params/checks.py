"""A set of parameters, judged for a flight with one output."""

from collections.abc import Container, Mapping
from typing import NamedTuple

from mavbridge.core.vehicle import Risk
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.profiles.profile import Danger, ParamContext, ParamNote, Profile


class Assessment(NamedTuple):
    """One set of parameters, judged."""

    calibration: RcCalibration | None
    unusable: str | None
    """Why there is no calibration, although the output needs one."""
    override_switch: int | None
    """Number of the channel that enables the output."""
    obstacles: tuple[ParamNote, ...]
    """Reasons for which the vehicle would not do as it is told."""
    dangers: tuple[Danger, ...]
    """Accepted ones included."""

    def endangers(self, before: "Assessment", *, accepted: Container[Risk]) -> bool:
        """True if this set of parameters must end a flight that was begun with the other."""
        new_risks = {danger.risk for danger in self.dangers} - {d.risk for d in before.dangers}
        return (
            self.calibration != before.calibration
            or self.override_switch != before.override_switch
            or not {each.names for each in self.obstacles}
            <= {each.names for each in before.obstacles}
            or any(risk not in accepted for risk in new_risks)
        )


def assess(profile: Profile, values: Mapping[str, float], context: ParamContext) -> Assessment:
    """Judge the parameters of a vehicle of this firmware."""
    is_override = context.output == "rc-override"
    ours: RcCalibration | None = None
    unusable: str | None = None
    try:
        ours = profile.calibration(values)
    except ValueError as error:
        unusable = str(error) if is_override else None
    return Assessment(
        ours,
        unusable,
        profile.override_switch(values) if is_override else None,
        tuple(profile.obstacles(values, context)),
        tuple(profile.dangers(values, context)),
    )
