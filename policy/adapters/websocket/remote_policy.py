"""A policy that computes on a server: one request a chunk, with a deadline."""

from dataclasses import replace

import numpy as np

from policy.adapters.interface import Interface
from policy.adapters.websocket.link import ServerLink
from policy.adapters.websocket.messages import (
    RESET_KEY,
    Message,
    MessageError,
    last_line,
    number_array,
    pack,
    to_message,
    unpack,
)
from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.engines.runner import level_state
from policy.errors import NoChunkError

ACTIONS_KEY = "actions"
"""Key of the actions in an answer, unless the contract file's own key is there."""
TRIAL_S = 120.0
"""Longest first answers, before any flight: servers compile on their first request."""
MOST_WAIT_S = 1.5
"""Longest deadline of any contract: the flight still ends at once when it is told to."""


def answer_deadline_s(contract: Contract) -> float:
    """Time after which the guard would no longer fly by the answer."""
    ages_s = (contract.max_state_age_s, contract.max_velocity_age_s, contract.max_feature_age_s)
    chunk_s = contract.horizon * contract.chunk_dt_s
    return min(min(ages_s) + contract.play_s, chunk_s, MOST_WAIT_S)


class RemotePolicy:
    """``predict`` by a server; keeps ``policy.protocol.SingleRatePolicy``.

    Until the first ``reset`` it waits as long as a server may take to compile; from then on no
    longer than ``answer_deadline_s``. What comes later is never flown.
    """

    def __init__(self, link: ServerLink, interface: Interface, *, is_ours: bool) -> None:
        """``is_ours``: the server is ``mavbridge serve``, and takes the history and the reset."""
        self.contract = replace(interface.contract, arrays="numpy", feature_dim=0)
        self._link = link
        self._interface = interface
        self._is_ours = is_ours
        self._timeout_s = TRIAL_S
        self._has_begun = False
        """A flight has begun, and the server has not been told."""
        self.round_trip_s = 0.0
        """From the newest request to its answer."""
        self.infer_s: float | None = None
        """What the server says of its own share of that."""

    def predict(
        self,
        image: FloatArray,
        state: FloatArray,
        action_history: FloatArray,
        num_diffusion_steps: int,
    ) -> FloatArray:
        """Ask the server for a chunk; it has diffusion steps of its own."""
        history = action_history[0] if self._is_ours else None
        message = to_message(self._interface, image[0], state[0], history=history)
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
        """Tell the server with the next request that a flight has begun."""
        self._has_begun = True
        self._timeout_s = answer_deadline_s(self.contract)

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def try_out(self) -> str:
        """Ask for two chunks of a dummy sample; returns a line with the time of the second one."""
        contract = self.contract
        image = np.zeros((1, *contract.image_shape), np.float32)
        history = np.zeros((1, contract.history_len, ACTION_DIM), np.float32)
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
            raise MessageError(
                f"actions {list(actions.shape)} where the contract has [horizon, 4] = "
                f"{list(wanted)}"
            )
        return self._interface.to_actions(actions.astype(np.float32))[None]
