"""A policy along an episode of a LeRobot dataset: one solve for each row.

``ObservationSource`` and ``SentHistory`` are those of the flight. A row is taken for one moment,
that of its image; LeRobot knows no other.
"""

from collections.abc import Iterator
from pathlib import Path

from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.records import FeatureFrame, VehicleState
from mavbridge.core.vehicle import Sticks
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.history import SentHistory
from mavbridge.flight.observation import ObservationSource, observation_ages_ns
from mavbridge.flight.settings import effective_freshness
from mavbridge.flight.state import Unavailable
from mavbridge.simulation.clock import START_NS, SteppedClock
from mavbridge.simulation.replay.actions import ActionPair
from policy.contract import Contract
from policy.data.flight_data import FlightData, ImageArray
from policy.data.lerobot import read_dataset
from policy.errors import NoChunkError
from policy.protocol import Executable


def open_episode(folder: Path, episode: int) -> FlightData:
    """One episode of a dataset.

    Raises:
        DatasetError: the dataset lacks our features, or is damaged.
        UserError: it has no such episode.
    """
    flights = read_dataset(folder)
    if not 0 <= episode < len(flights):
        raise UserError(f"--episode {episode}: {folder} has the episodes 0 to {len(flights) - 1}")
    return flights[episode]


class EpisodeReplay:
    """One pass over an episode."""

    def __init__(
        self, episode: FlightData, executable: Executable, config: FlyConfig, clock: SteppedClock
    ) -> None:
        """``clock``: followed by a policy that follows one at all; the rows let it pass.

        Raises:
            UserError: the policy takes or puts out what the dataset does not hold.
        """
        contract = executable.contract
        _check(episode, contract)
        self._episode, self._executable, self._clock = episode, executable, clock
        span_ns = observation_ages_ns(contract)[0]
        self._cache = FeatureCache(span_ns=span_ns)
        limits = effective_freshness(contract, config.limits)
        self._observations = ObservationSource(
            contract,
            caches=[self._cache],
            join=executable.join,
            max_feature_age_ns=limits.feature_ns,
            states_span_ns=span_ns,
        )
        self._history = SentHistory(length=contract.history_len, dt_s=contract.history_dt_s)
        self._sent = 0

    def run(self) -> Iterator[ActionPair]:
        """Each row, as far as the policy returned a chunk for it."""
        for row, image in enumerate(self._episode.decode()):
            since_ns = int(self._episode.captured_ns[row] - self._episode.captured_ns[0])
            self._clock.sleep_until_ns(START_NS + since_ns)
            if (pair := self._solve(row, image)) is not None:
                yield pair

    def _solve(self, row: int, image: ImageArray) -> ActionPair | None:
        episode, now_ns = self._episode, int(self._episode.captured_ns[row])
        while self._sent < len(episode.sent_ns) and episode.sent_ns[self._sent] < now_ns:
            sticks = Sticks(*episode.sent[self._sent].tolist())
            self._history.append(sticks, int(episode.sent_ns[self._sent]))
            self._sent += 1
        value = self._executable.encode(image, 0).copy()
        self._cache.publish(
            FeatureFrame(frame_id=row, captured_ns=now_ns, ready_ns=now_ns, value=value)
        )
        state = VehicleState(
            values=episode.state[row],
            attitude_ns=now_ns,
            rate_ns=now_ns,
            velocity_ns=now_ns,
            specific_force_ns=now_ns,
        )
        self._observations.remember(state)
        self._observations.push(state)
        seen = self._observations.observe(state, now_ns)
        if isinstance(seen, Unavailable):
            return None
        history = self._history.resample(now_ns)
        try:
            chunk = self._executable.act(seen.encoded, seen.states, history)
        except NoChunkError:
            return None
        return ActionPair(
            at_s=(now_ns - int(episode.captured_ns[0])) / NS_PER_S,
            policy=tuple(chunk[0, 0].tolist()),
            recorded=tuple(episode.target[row].tolist()),
        )


def _check(episode: FlightData, contract: Contract) -> None:
    if contract.action != "sticks" or len(contract.cameras) != 1 or contract.state_extras:
        raise UserError(
            f"{episode.name} holds sticks, one camera and the 13 numbers of the state; the policy "
            f"puts out {contract.action}, sees {len(contract.cameras)} cameras and takes besides "
            f"{', '.join(contract.state_extras) or 'nothing'}"
        )
    if contract.state_frame != episode.state_frame:
        raise UserError(
            f"{episode.name} holds its state in {episode.state_frame}, the policy takes "
            f"{contract.state_frame}"
        )
