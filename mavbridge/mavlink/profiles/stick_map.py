"""The map from a policy's sticks to the vehicle's, as its mode and its parameters change."""

from collections import Counter
from collections.abc import Mapping

from mavbridge.core.vehicle import StickGains, Sticks
from mavbridge.mavlink.profiles.profile import Profile
from mavbridge.mavlink.profiles.sticks import IDENTITY, StickCurves


class StickMap:
    """Maps the policy's sticks, and counts those that mean more than the vehicle can do.

    Only what a policy means goes through it: the throttle at the bottom that arming demands is a
    position of the stick, and the centre is the centre of every vehicle.
    """

    def __init__(self, profile: Profile, gains: StickGains | None) -> None:
        self._profile = profile
        self._gains = gains
        self._mode: str | None = None
        self._values: Mapping[str, float] = {}
        self._told: set[str] = set()
        self._curves: StickCurves = IDENTITY
        self.saturated: Counter[str] = Counter()
        """Times that each stick, by name, meant more than the vehicle can do."""

    def follow(self, mode: str, values: Mapping[str, float]) -> tuple[str, ...]:
        """Map for this mode and these parameters from now on.

        To be called when either may have changed. Returns sentences for the user, each only once.
        """
        if mode == self._mode and values == self._values:
            return ()
        self._mode, self._values = mode, dict(values)
        self._curves = self._profile.stick_curves(values, mode, self._gains)
        news = tuple(note for note in self._curves.notes if note not in self._told)
        self._told.update(news)
        return news

    def to_vehicle(self, sticks: Sticks) -> Sticks:
        """The vehicle's sticks for the policy's."""
        self.saturated.update(self._curves.saturated(sticks))
        return self._curves.to_vehicle(sticks)

    def to_policy(self, sticks: Sticks) -> Sticks:
        """The policy's sticks for the vehicle's, as they were sent or as the pilot holds them."""
        return self._curves.to_policy(sticks)
