"""Teach a gate policy's encoder that every look shows what the nominal look shows.

python -m benchmarks.teach_looks before.safetensors --minutes 120 --out after.safetensors

The policy flies courses of other looks, with the newest weights. Each moment of these flights is
then drawn twice: in the nominal look, and in one of those that demonstrations have. From both
views, also disturbed, the encoder learns to give the feature that its teacher gives for the nominal
view, and to cause the same chunk. The head keeps its weights.
"""

import math
from collections import deque
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import replace
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from cyclopts import App
from numpy.typing import NDArray
from torch import Tensor

from mavbridge.commands.output import table_console
from mavbridge.config.episodes import COURSE_SEEDS, CourseKind
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.records import Solve
from mavbridge.flight.policies import load_configured_policy
from mavbridge.simulation.flight import SIM_CAMERA_PX, SimulatedFlight
from mavbridge.simulation.world import make_vehicle
from policy.checkpoints.networks import load_checkpoint, save_checkpoint
from policy.contract import Contract, FloatArray
from policy.engines.torch_engines import FasterThreads
from policy.nets.toge import Toge, TogeConfig
from policy.preprocess import fit_image
from policy.training.batches import disturb, normalise_image
from policy.training.run import GRADIENT_LIMIT, computing_in, update_average, uses_bf16
from policy.training.settings import learning_rate_factor
from sitl.camera.fpv import FpvRenderer
from sitl.course import Course
from sitl.vehicle.conditions import NOMINAL
from sitl.vehicle.dynamics import BodyState
from sitl.vehicle.looks import training_conditions
from sitl.vehicle.rotation import from_euler, multiply

app = App(help=__doc__)

FIRST_SEED = 600_000
"""Of the flights: neither demonstrations nor evaluations have these courses."""
FLIGHT_S, RUN_OUT_S = 35.0, 5.0
"""Longest flight, and time flown on after the last gate: views without a gate hold the place."""
VIEWS, VIEWS_OF_A_LOOK = 2000, 80
"""Moments drawn of each flight, and how many of them in one look."""
CAPACITY = 160_000
"""Moments kept, each with two views; the oldest are replaced."""
SHIFT_M, TURN_RAD = (0.3, 0.3, 0.2), math.radians(4.0)
"""Standard deviations by which half of the views are off the flown path."""
LENS = (
    *("camera_tilt_rad", "camera_roll_rad", "camera_yaw_rad", "camera_offset_body_m"),
    *("horizontal_fov_rad", "exposure_time_s", "readout_time_s"),
)
"""Conditions that the nominal view shares with the other one: they move the gates in the image."""
BATCH, MOST_RATE, AVERAGED, REPORTED = 128, 6e-4, 0.999, 200
NOMINAL_SHARE, PLAIN_SHARE, PASTED_SHARE = 0.36, 0.55, 0.25
"""Shares of nominal views, of views as drawn, and of the others in which a part is replaced."""
MOST_NOISE = 15.0
"""Largest standard deviation of the noise on a disturbed view, in levels of 0..255."""


class Viewpoint(NamedTuple):
    """True state at the exposure of an image, and what the head got with its feature."""

    body: BodyState
    state: FloatArray
    history: FloatArray


class Views(NamedTuple):
    """Moments, drawn twice: images uint8 [N, side, side, 3], states, histories."""

    nominal: NDArray[np.uint8]
    other: NDArray[np.uint8]
    state: FloatArray
    history: FloatArray


def fly(seed: int, weights: Path, *, by_rates: bool) -> tuple[Course, list[Viewpoint]]:
    """Fly a course in training conditions by these weights; return the moments of its solves.

    Weights for body rates fly races, those for sticks easy courses.
    """
    courses: CourseKind = "race" if by_rates else "easy"
    conditions, is_px4 = training_conditions(seed), seed % 8 == 0
    vehicle = make_vehicle(autopilot="px4" if is_px4 else "ardupilot", conditions=conditions)
    flight = SimulatedFlight(course_seed=COURSE_SEEDS[courses] + seed, seed=seed, vehicle=vehicle)
    bodies: dict[int, BodyState] = {}
    moments: dict[int, Viewpoint] = {}

    def keep(solve: Solve) -> None:
        frame_id = solve.frame_ids[-1][0]
        moments[frame_id] = Viewpoint(bodies[frame_id], solve.states[0], solve.history[0])

    flight.exposure_watchers.append(lambda seen: bodies.update({seen.frame_id: seen.body}))
    flight.solve_watchers.append(keep)
    policy = PolicyConfig(policy="toge-rates" if by_rates else "toge", checkpoint=weights)
    with load_configured_policy(policy, MonotonicClock()) as loaded:
        flight.fly(loaded.runner, max_time_s=FLIGHT_S, run_out_s=RUN_OUT_S, ends_by_stop=False)
    return flight.course, list(moments.values())


def draw(seed: int, course: Course, moments: list[Viewpoint], contract: Contract) -> Views:
    """Draw ``VIEWS`` of the moments, some off the flown path, in the nominal look and in others."""
    random = np.random.default_rng((seed, 1))
    pairs, chosen = [], []
    for number in range(VIEWS // VIEWS_OF_A_LOOK):
        look = training_conditions(VIEWS * seed + number)
        nominal = replace(NOMINAL, **{name: getattr(look, name) for name in LENS})
        renderers = [
            FpvRenderer(course, SIM_CAMERA_PX, SIM_CAMERA_PX, each) for each in (nominal, look)
        ]
        for place in random.integers(len(moments), size=VIEWS_OF_A_LOOK):
            body = moments[place].body
            position, attitude = np.array(body.position_ned_m), body.ned_from_body_wxyz
            if random.random() < 0.5:
                position += random.normal(0.0, SHIFT_M)
                attitude = multiply(attitude, from_euler(*random.normal(0.0, TURN_RAD, 3)))
            north_m, east_m, down_m = map(float, position)
            pose = (north_m, east_m, down_m), attitude, body.rate_body_radps
            pairs.append([fit_image(each.render(*pose), contract) for each in renderers])
            chosen.append(moments[place])
    nominal_views, other_views = (np.array(views, np.uint8) for views in zip(*pairs, strict=True))
    states, histories = (
        np.array([getattr(moment, name) for moment in chosen], np.float32)
        for name in ("state", "history")
    )
    return Views(nominal_views, other_views, states, histories)


def fly_and_draw(seed: int, weights: Path) -> Views:
    """Return the views of one flight; runs in a worker process."""
    torch.set_num_threads(1)
    contract = load_toge(weights).contract
    course, moments = fly(seed, weights, by_rates=contract.action == "rates")
    return draw(seed, course, moments, contract)


class Kept:
    """The newest ``CAPACITY`` moments, and the teacher's features of their nominal views."""

    def __init__(self, teacher: Toge) -> None:
        self._teacher = teacher
        self._flights: deque[tuple[Views, FloatArray]] = deque(maxlen=CAPACITY // VIEWS)

    def __len__(self) -> int:
        return len(self._flights)

    def add(self, views: Views) -> None:
        """Take the views of a flight, in place of the oldest."""
        with torch.inference_mode():
            features = [
                self._teacher.encode_visual(self._input(views.nominal[at : at + BATCH])).numpy()
                for at in range(0, VIEWS, BATCH)
            ]
        self._flights.append((views, np.concatenate(features)))

    def _input(self, images: NDArray[np.uint8]) -> Tensor:
        scaled = torch.from_numpy(images).permute(0, 3, 1, 2) / 255.0
        return normalise_image(scaled, self._teacher.contract)

    def batch(self, random: np.random.Generator) -> list[Tensor]:
        """Return images, and the features, states and histories that belong to them."""
        rows = []
        for kind in random.random(BATCH):
            views, features = self._flights[random.integers(len(self))]
            at = random.integers(VIEWS)
            image = (views.nominal if kind < NOMINAL_SHARE else views.other)[at].copy()
            if random.random() > PLAIN_SHARE:
                self._spoil(image, random)
            rows.append((image, features[at], views.state[at], views.history[at]))
        images, *others = (np.array(column) for column in zip(*rows, strict=True))
        return [self._input(images), *map(torch.from_numpy, others)]

    def _spoil(self, image: NDArray[np.uint8], random: np.random.Generator) -> None:
        """Disturb an image as in training, twice; paste a part of another one; add noise."""
        if random.random() < PASTED_SHARE:
            views, _ = self._flights[random.integers(len(self))]
            side = image.shape[0]
            height, width = random.integers(side // 8, side // 2, size=2)
            top, left = random.integers(side - height), random.integers(side - width)
            part = np.s_[top : top + height, left : left + width]
            image[part] = views.other[random.integers(VIEWS)][part]
        disturb(image[None], random)
        disturb(image[None], random)
        noise = random.normal(0.0, random.uniform(0.0, MOST_NOISE), image.shape)
        cv2.add(image, noise.astype(np.int16), dst=image, dtype=cv2.CV_8U)


def loss_of(net: Toge, batch: list[Tensor]) -> Tensor:
    """Return how far the encoder is from the teacher's features, and from what they cause."""
    images, feature, state, history = batch

    def chunk(of: Tensor) -> Tensor:
        return net.head.read(net.condition(of, net.state_encoder(state), history))

    with computing_in(images.device, uses_bf16("auto", images.device)):
        code = net.backbone(images.contiguous(memory_format=torch.channels_last))
    seen = net.visual_projection(code.float())
    wanted = chunk(feature)
    of_feature = ((seen - feature) / feature.std(0).mean()).square().mean(1)
    of_chunk = ((chunk(seen) - wanted) / wanted.std((0, 1))).square().mean((1, 2))
    # Roots: views that show no gate at all must not outweigh the others.
    loss: Tensor = 0.3 * (of_feature + 1e-3).sqrt().mean() + (of_chunk + 1e-4).sqrt().mean()
    return loss


def load_toge(path: Path) -> Toge:
    """Read the weights of a TOGE; raise CheckpointError for those of another network."""
    return load_checkpoint(path, fallback=TogeConfig())


@app.default
def main(
    before: Path,
    *,
    out: Path,
    minutes: float,
    workers: int = 1,
    teacher: Path | None = None,
) -> None:
    """Teach the encoder of weights for ``toge`` or ``toge-rates``.

    Args:
        before: weights to start from.
        out: the weights, packed; written at the end.
        minutes: time to train; the learning rate falls with it.
        workers: flights at a time, beside the training.
        teacher: weights with the same head; what they compute for the nominal look is taught.
            Default: ``before``.
    """
    clock, random = MonotonicClock(), np.random.default_rng(FIRST_SEED)
    net, average, kept = load_toge(before), load_toge(before), Kept(load_toge(teacher or before))
    newest = out.with_suffix(".newest.safetensors")
    save_checkpoint(newest, average)
    net.train().requires_grad_(False)
    taught = [*net.backbone.parameters(), *net.visual_projection.parameters()]
    for parameter in taught:
        parameter.requires_grad_(True)
    optimiser = torch.optim.AdamW(taught, lr=MOST_RATE, weight_decay=1e-4)
    threads = FasterThreads(lambda: clock.now_ns() / NS_PER_S)
    begun_ns, seeds, losses = clock.now_ns(), count(FIRST_SEED), deque[float](maxlen=REPORTED)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        flights = {pool.submit(fly_and_draw, next(seeds), newest) for _ in range(workers)}
        for step in count(1):
            share = (clock.now_ns() - begun_ns) / NS_PER_S / 60.0 / minutes
            if share >= 1.0:
                break
            patience_s = 0.0 if kept else None
            done, flights = wait(flights, timeout=patience_s, return_when=FIRST_COMPLETED)
            for flight in done:
                kept.add(flight.result())
                flights.add(pool.submit(fly_and_draw, next(seeds), newest))
            optimiser.param_groups[0]["lr"] = MOST_RATE * learning_rate_factor(share)
            with threads.step():
                loss = loss_of(net, kept.batch(random))
                optimiser.zero_grad()
                torch.autograd.backward(loss)
            torch.nn.utils.clip_grad_norm_(taught, GRADIENT_LIMIT)
            optimiser.step()
            update_average(average, net, AVERAGED, step)
            losses.append(loss.item())
            if step % REPORTED == 0:
                said = f"step {step}: {len(kept)} flights, loss {np.mean(losses):.3f}"
                table_console().print(said)
                save_checkpoint(newest, average)
    save_checkpoint(out, average, packed=True)


if __name__ == "__main__":
    app()
