"""Which output carries the actions of a policy to a vehicle."""

from mavbridge.core.errors import PeerError
from mavbridge.core.vehicle import ActionMeaning, Output
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.outputs.manual_control import ManualControlOutput
from mavbridge.mavlink.outputs.output import ActionOutput
from mavbridge.mavlink.outputs.override import OverrideOutput
from mavbridge.mavlink.profiles.profile import Profile


def choose_output(
    meaning: ActionMeaning, wanted: Output | None, *, profile: Profile, codec: Codec
) -> ActionOutput:
    """The output that was asked for, or the usual one of such actions and this vehicle.

    Raises:
        PeerError: this vehicle cannot be flown with it.
    """
    name = wanted or profile.outputs[meaning.kind]
    if (refusal := profile.refusals.get(name)) is not None:
        raise PeerError(refusal)
    return ManualControlOutput(codec) if name == "manual-control" else OverrideOutput(codec)
