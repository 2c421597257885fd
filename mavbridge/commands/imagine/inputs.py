"""The world model as the loop calls it, and the observed past from which a rollout starts."""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.records import FloatArray, ImageArray
from mavbridge.core.vehicle import Sticks
from mavbridge.recording.flight_folder import RecordedFlight
from policy.nets.world_model.config import WorldModelConfig
from policy.nets.world_model.model import WorldModel
from policy.preprocess import resize

Part: TypeAlias = Literal["sample", "decode", "write"]


class ImaginationError(MavbridgeError):
    """The world model imagined NaN or infinity."""


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Context manager: let torch use ``count`` threads, at least one."""
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, count))
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Sampler:
    """One world model in both roles, simulation and decision. Used by the loop's thread."""

    def __init__(self, model: WorldModel, *, ddim_steps: int, clock: Clock) -> None:
        """Wrap a model that is already on its device."""
        self.model = model
        self.config: WorldModelConfig = model.config
        self.clock = clock
        self.seconds: dict[Part, float] = {"sample": 0.0, "decode": 0.0, "write": 0.0}
        """Time of the loop's thread; decode: waits for room in the decoder's queue included."""
        self.frames_decoded = 0
        self._ddim_steps = ddim_steps
        self._device = next(model.parameters()).device

    @contextmanager
    def timed(self, part: Part) -> Iterator[None]:
        """Context manager: add the block's time."""
        begun_ns = self.clock.now_ns()
        try:
            yield
        finally:
            self.seconds[part] += (self.clock.now_ns() - begun_ns) / NS_PER_S

    def encode(self, images: NDArray[np.uint8]) -> Tensor:
        """Encode images [N, H, W, 3] to latents [N, C, h, w]."""
        with torch.inference_mode():
            return self.model.encode(torch.from_numpy(images).to(self._device))

    def decode(self, latents: Tensor) -> NDArray[np.uint8]:
        """Decode latents [N, C, h, w] to images [N, H, W, 3].

        On one thread, like ``FrameDecoder``, because splitting a sum changes its rounding.
        """
        with torch.inference_mode(), torch_threads(1), self.timed("decode"):
            pixels: NDArray[np.uint8] = self.model.decode(latents).cpu().numpy()
        self.frames_decoded += len(pixels)
        return pixels

    def sample(
        self, latents: Tensor, states: FloatArray, actions: FloatArray | None, *, seed: int
    ) -> tuple[Tensor, FloatArray, FloatArray]:
        """Simulate the actions [frames, 4], or sample actions if they are None.

        Return latents [frames, C, h, w], on the model's device, states [frames, 13] and actions.

        Latents are [1, context_frames, C, h, w], states [1, context_frames, 13]; ``seed`` is that
        of the noise.

        Raises:
            ImaginationError: the result is not finite.
        """
        with torch.inference_mode(), self.timed("sample"):
            imagined = self.model.sample(
                latents,
                self._tensor(states),
                None if actions is None else self._tensor(actions[None]),
                ddim_steps=self._ddim_steps,
                noise_seed=seed,
            )
            sampled_states = imagined.states[0].float().cpu().numpy()
            sampled_actions = imagined.actions[0].float().cpu().numpy()
        if not (np.isfinite(sampled_states).all() and np.isfinite(sampled_actions).all()):
            raise ImaginationError(
                "the world model imagined NaN or infinity: its weights are damaged, or it has left "
                "what it was trained on; try more --ddim-steps, or another checkpoint"
            )
        return imagined.latents[0], sampled_states, sampled_actions

    def _tensor(self, values: FloatArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self._device)


MAX_STATE_AGE_NS = 100_000_000
"""Oldest state, at the exposure of a frame, that still belongs to it."""
MAX_HISTORY_S = 10.0
"""Longest history that any policy uses."""


@dataclass(frozen=True, kw_only=True)
class RolloutStart:
    """Observed past of a rollout, oldest first; the newest frame is its time zero."""

    images: NDArray[np.uint8]
    """[context_frames, H, W, 3] at the world model's size."""
    states: FloatArray
    """[context_frames, 13]"""
    newest_ns: int
    """Exposure of the newest frame, on the flight's clock."""
    sent: tuple[tuple[int, Sticks | None], ...]
    """Sticks sent before ``newest_ns``, each with its time; None: released."""


def read_start(flight: RecordedFlight, config: WorldModelConfig, start_s: float) -> RolloutStart:
    """Read the context, from ``start_s`` after the first frame that has a state.

    Raises:
        UserError: the flight is too short, has no states, or has them in another frame.
        VideoError: its video is damaged.
    """
    _require_state_frame(flight, config)
    captured_ns = flight.frames["captured_ns"].to_numpy()
    ticks = flight.ticks.filter(flight.ticks["state"].is_valid())
    if not (len(captured_ns) and ticks.num_rows):
        lacks = "no state of the vehicle" if len(captured_ns) else "no frames"
        raise UserError(f"--start {flight.folder} holds {lacks}: name a flight that was flown")
    state_ns = ticks["attitude_ns"].to_numpy()
    with_state = captured_ns[captured_ns >= state_ns[0]]
    first_ns = int(with_state[0] if len(with_state) else captured_ns[-1] + 1)
    first_ns += round(start_s * NS_PER_S)
    dt_s = config.frame_dt_s
    wanted_ns = [first_ns + round(k * dt_s * NS_PER_S) for k in range(config.context_frames)]
    if wanted_ns[-1] > captured_ns[-1] + round(dt_s * NS_PER_S / 2):
        raise UserError(
            f"--start {flight.folder} is too short: {config.context_frames} frames {dt_s:g} s "
            f"apart are needed from {start_s:g} s after its first state on, its frames end "
            f"{(captured_ns[-1] - first_ns) / NS_PER_S + start_s:.2f} s after it"
        )
    frames = [_nearest(captured_ns, at_ns) for at_ns in wanted_ns]
    newest_ns = int(captured_ns[frames[-1]])
    # The newest state known at each exposure.
    known = np.searchsorted(state_ns, captured_ns[frames], side="right") - 1
    for row, at_ns in zip(known, captured_ns[frames], strict=True):
        if row < 0 or at_ns - state_ns[row] > MAX_STATE_AGE_NS:
            raise UserError(
                f"--start {flight.folder} has no state of the vehicle there, at "
                f"{(at_ns - state_ns[0]) / NS_PER_S:.2f} s: choose another --start-at"
            )
    return RolloutStart(
        images=_start_images(flight, frames, config.image_size),
        states=np.array(ticks["state"].take(known).to_pylist(), np.float32),
        newest_ns=newest_ns,
        sent=_sent_before(flight, newest_ns),
    )


def _require_state_frame(flight: RecordedFlight, config: WorldModelConfig) -> None:
    contract, wanted = flight.meta.contract, config.contract.state_frame
    if contract is None or contract.state_frame != wanted:
        found = "an unknown frame" if contract is None else contract.state_frame
        raise UserError(
            f"--start {flight.folder} has its states in {found}, the world model takes {wanted}: "
            "name a flight of that kind, or a world model that was trained on this one"
        )
    if contract.action != "sticks":
        raise UserError(
            f"--start {flight.folder} was flown by {contract.action}, the world model takes sticks"
        )


def _sent_before(flight: RecordedFlight, now_ns: int) -> tuple[tuple[int, Sticks | None], ...]:
    since_ns = now_ns - round(MAX_HISTORY_S * NS_PER_S)
    columns = (flight.ticks["sent_ns"].to_pylist(), flight.ticks["sent"].to_pylist())
    return tuple(
        (sent_ns, None if sent is None else Sticks(*sent))
        for sent_ns, sent in zip(*columns, strict=True)
        if since_ns <= sent_ns < now_ns
    )


def _start_images(flight: RecordedFlight, frames: list[int], size: int) -> NDArray[np.uint8]:
    found: dict[int, ImageArray] = {}
    for index, rgb in enumerate(flight.rgb_images()):
        if index in frames:
            found[index] = resize(rgb, size, size)
        if index >= frames[-1]:
            break
    return np.stack([found[index] for index in frames])


def _nearest(stamps_ns: NDArray[np.int64], at_ns: int) -> int:
    return int(np.abs(stamps_ns - at_ns).argmin())


class RealFrames:
    """Images of the flight's camera after the start, at the world model's times and size.

    Decodes forward only. Keeps as many frames as one segment has, because segments overlap.
    """

    def __init__(self, flight: RecordedFlight, config: WorldModelConfig, newest_ns: int) -> None:
        self._captured_ns: NDArray[np.int64] = flight.frames["captured_ns"].to_numpy()
        self._images: Iterator[ImageArray] = flight.rgb_images()
        self._config = config
        self._newest_ns = newest_ns
        self._decoded = 0
        self._newest_step = 0
        self._window: deque[ImageArray] = deque(maxlen=config.frames)

    def at(self, step: int) -> ImageArray | None:
        """Return the frame ``step`` times ``frame_dt_s`` after the start; None after the flight.

        Raises:
            ValueError: it has left the window: steps can go back by one segment at most.
            VideoError: the video is damaged.
        """
        while self._newest_step < step:
            dt_s, size = self._config.frame_dt_s, self._config.image_size
            at_ns = self._newest_ns + round((self._newest_step + 1) * dt_s * NS_PER_S)
            if at_ns > self._captured_ns[-1]:
                return None
            rgb = None
            while self._decoded <= _nearest(self._captured_ns, at_ns):
                rgb = next(self._images)
                self._decoded += 1
            self._newest_step += 1
            # Two steps share a frame only if the camera is slower than the world model.
            self._window.append(self._window[-1] if rgb is None else resize(rgb, size, size))
        if self._newest_step - step >= len(self._window):
            raise ValueError(f"step {step} has left the window")
        return self._window[step - self._newest_step - 1]
