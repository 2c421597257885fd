"""A picture of what the world model imagines, under what was really seen.

python -m benchmarks.imagined_strip FLIGHT --at 0.5 --out docs/images/imagined.png

The sticks are those that were flown, and in the last row the same with the yaw stick full right.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from cyclopts import App
from matplotlib import rc_context
from matplotlib.figure import Figure

from mavbridge.commands.evaluate_imagination.flights import (
    FlightWindow,
    choose_windows,
    read_episode,
    with_images,
)
from mavbridge.commands.imagine.run import load_model
from mavbridge.commands.imagine.sampling import Sampler
from mavbridge.commands.output import FIGURE_STYLE
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.records import FloatArray, ImageArray
from policy.contract import ACTION_NAMES

STEPS = (1, 4, 8, 16)
DPI = 64
"""A frame is two inches wide."""
MOST_WINDOWS = 1_000_000
app = App(help=__doc__)


@app.default
def main(flight: Path, *, out: Path, at: float = 0.5, world_model: Path | None = None) -> None:
    """Draw one window of one flight.

    Args:
        flight: a flight that the model was not trained on.
        out: where to write the PNG.
        at: where in the flight, from 0 to 1.
        world_model: weights; by default those that come with mavbridge.

    Raises:
        UserError: the flight is too short.
    """
    model = load_model(world_model, ddim_steps=4, device="cpu")
    sampler = Sampler(model, ddim_steps=4, decode_all=False, clock=MonotonicClock())
    config = sampler.config
    every, _ = choose_windows(
        [read_episode(flight, config)], config, steps=config.frames, count=MOST_WINDOWS
    )
    if not every:
        least_s = config.frames * config.frame_dt_s
        raise UserError(f"{flight} is too short: name one that is longer than {least_s:g} s")
    chosen = every[round(at * (len(every) - 1))]
    steps = range(config.context_frames + config.frames)
    window, images = next(with_images([chosen], steps, config.image_size))
    draw(strip(sampler, window, images), config.frame_dt_s, out)


def strip(
    sampler: Sampler, window: FlightWindow, images: Mapping[int, ImageArray]
) -> dict[str, list[ImageArray]]:
    """Rows of frames at ``STEPS`` by name."""
    now = sampler.config.context_frames - 1
    turned: FloatArray = window.actions.copy()
    turned[:, ACTION_NAMES.index("yaw")] = 1.0
    return {
        "real": [images[now + step] for step in STEPS],
        "imagined": imagine(sampler, window, images, window.actions),
        "copy last": [images[now]] * len(STEPS),
        "yaw full right": imagine(sampler, window, images, turned),
    }


def imagine(
    sampler: Sampler, window: FlightWindow, images: Mapping[int, ImageArray], actions: FloatArray
) -> list[ImageArray]:
    """The frames at ``STEPS`` that follow from sticks [frames, 4]."""
    context = sampler.config.context_frames
    past = sampler.encode(np.stack([images[step] for step in range(context)]))[None]
    imagined = sampler.sample(past, window.states[None, :context], actions, seed=0)
    return list(sampler.decode(imagined.latents[[step - 1 for step in STEPS]]))


def draw(rows: Mapping[str, list[ImageArray]], step_s: float, path: Path) -> None:
    """Write the PNG."""
    with rc_context(FIGURE_STYLE | {"axes.grid": False}):
        figure = Figure(figsize=(2.2 + 2 * len(STEPS), 0.5 + 2 * len(rows)), dpi=DPI)
        panels = figure.subplots(len(rows), len(STEPS))
        for line, (name, frames) in zip(panels, rows.items(), strict=True):
            for axes, step, frame in zip(line, STEPS, frames, strict=True):
                axes.imshow(frame, interpolation="nearest")
                axes.set_xticks([])
                axes.set_yticks([])
                if axes in panels[0]:
                    axes.set_title(f"{step * step_s:.1f} s")
            line[0].set_ylabel(name, rotation=0, ha="right", va="center")
        figure.tight_layout(pad=0.4)
        figure.savefig(path)


if __name__ == "__main__":
    app()
