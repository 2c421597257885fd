"""Policy on a server: one request per chunk, with a deadline."""

from dataclasses import replace

import numpy as np

from policy.adapters.interface import Interface
from policy.adapters.websocket.link import ServerLink
from policy.adapters.websocket.messages import (
    RESET_KEY,
    Message,
    MessageError,
    number_array,
    pack,
    to_message,
    unpack,
)
from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.engines.runner import level_state
from policy.errors import NoChunkError
from policy.files import last_line

ACTIONS_KEY = "actions"
"""Key of the actions in an answer, unless the contract file names another."""
TRIAL_S = 120.0
"""Timeout of the first answers, before any flight: servers compile on their first request."""
MOST_WAIT_S = 1.5
"""Upper bound of the deadline for any contract, so that a flight still ends promptly."""


def answer_deadline_s(contract: Contract) -> float:
    """Return the time after which the guard would reject the answer [s]."""
    ages_s = (contract.max_state_age_s, contract.max_velocity_age_s, contract.max_feature_age_s)
    chunk_s = contract.horizon * contract.chunk_dt_s
    return min(min(ages_s) + contract.play_s, chunk_s, MOST_WAIT_S)


class RemotePolicy:
    """``policy.protocol.SingleRatePolicy`` whose ``predict`` runs on a server.

    Until the first ``reset`` it waits for the server's compilation; from then on at most
    ``answer_deadline_s``. A later answer is never flown.
    """

    def __init__(self, link: ServerLink, interface: Interface, *, is_ours: bool) -> None:
        """``is_ours``: the server is ``mavbridge serve``, which takes the history and the reset."""
        self.contract = replace(interface.contract, arrays="numpy", feature_dim=0)
        self._link = link
        self._interface = interface
        self._is_ours = is_ours
        self._timeout_s = TRIAL_S
        self._has_begun = False
        """True if a flight has begun and the server has not been told."""
        self.round_trip_s = 0.0
        """Time from the newest request to its answer."""
        self.infer_s: float | None = None
        """The server's own share of the round trip, as it reports it."""

    def predict(
        self,
        image: FloatArray,
        state: FloatArray,
        action_history: FloatArray,
        num_diffusion_steps: int,
    ) -> FloatArray:
        """Ask the server for a chunk; the server sets the number of diffusion steps."""
        message = to_message(
            self._interface,
            image[0],
            state[0],
            action_history[0],
            is_ours=self._is_ours,
            delay_s=self.round_trip_s,
        )
        if self._is_ours and self._has_begun:
            message[RESET_KEY] = True
        answer = self._link.ask(pack(message), self._timeout_s)
        self._has_begun, self.round_trip_s = False, answer.round_trip_s
        if isinstance(answer.data, str):
            raise NoChunkError(f"the policy server failed: {last_line(answer.data)}")
        try:
            return self._chunk(unpack(answer.data))
        except MessageError as error:
            raise NoChunkError(f"the policy server's answer is {error}") from error

    def reset(self) -> None:
        """With the next request, tell the server that a flight has begun."""
        self._has_begun = True
        self._timeout_s = answer_deadline_s(self.contract)

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def try_out(self) -> str:
        """Request two chunks of a dummy sample; return a line with the second one's time."""
        contract = self.contract
        image = np.zeros((1, *contract.image_shape), np.float32)
        history = np.zeros((1, *contract.history_shape), np.float32)
        for _ in range(2):  # the first one may compile
            self.predict(image, level_state(contract), history, 1)
        share = "" if self.infer_s is None else f", {1e3 * self.infer_s:.1f} ms of them its own"
        return (
            f"the policy server answers in {1e3 * self.round_trip_s:.1f} ms{share}; what takes "
            f"longer than {1e3 * answer_deadline_s(contract):.0f} ms is not flown"
        )

    def _chunk(self, message: Message) -> FloatArray:
        timing = message.get("server_timing")
        infer_ms = timing.get("infer_ms") if isinstance(timing, dict) else None
        self.infer_s = 1e-3 * infer_ms if isinstance(infer_ms, int | float) else None
        own_key = self._interface.action_key
        actions = number_array(message, own_key if own_key in message else ACTIONS_KEY)
        if actions.ndim == 3 and actions.shape[0] == 1:
            actions = actions[0]
        wanted = (self.contract.horizon, ACTION_DIM)
        if actions.shape != wanted:
            advice = "set [contract] horizon to what the server returns"
            if actions.shape[1:] != wanted[1:]:
                advice = "the server has to cut out the four numbers that fly a multirotor"
            raise MessageError(
                f"actions {list(actions.shape)} where the contract has [horizon, 4] = "
                f"{list(wanted)}: {advice}"
            )
        return self._interface.to_actions(actions.astype(np.float32))[None]
