"""Choice of the output that carries the actions of a policy to a vehicle."""

from mavbridge.core.errors import PeerError
from mavbridge.core.vehicle import ActionKind, ActionMeaning, Output
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.outputs.attitude import AttitudeOutput
from mavbridge.mavlink.outputs.manual_control import ManualControlOutput
from mavbridge.mavlink.outputs.output import ActionOutput
from mavbridge.mavlink.outputs.override import OverrideOutput
from mavbridge.mavlink.outputs.velocity import VelocityOutput
from mavbridge.mavlink.profiles.profile import Profile

CARRIED: dict[Output, ActionKind] = {
    "rc-override": "sticks",
    "manual-control": "sticks",
    "attitude": "attitude",
    "rates": "rates",
    "velocity": "velocity",
}
"""Kind of action that each output carries."""


def choose_output(
    meaning: ActionMeaning, wanted: Output | None, profile: Profile, codec: Codec
) -> ActionOutput:
    """The output that was asked for, or the usual one of such actions and this vehicle.

    Raises:
        PeerError: this vehicle, or such actions, cannot be flown with it.
    """
    usual = profile.outputs[meaning.kind]
    name = wanted or usual
    if CARRIED[name] != meaning.kind:
        raise PeerError(
            f"--output {name} carries {CARRIED[name]}, and the actions of this policy are "
            f"{meaning.kind}: use --output auto, which is {usual} here"
        )
    if (refusal := profile.refusals.get(name)) is not None:
        raise PeerError(refusal)
    match name:
        case "rc-override":
            return OverrideOutput(codec, meaning.stick_gains)
        case "manual-control":
            return ManualControlOutput(codec, meaning.stick_gains)
        case "velocity":
            return VelocityOutput(codec, meaning)
        case "attitude" | "rates":
            return AttitudeOutput(codec, meaning, profile, name)
