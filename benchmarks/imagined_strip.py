"""A picture of what the world model imagines, under what was really seen.

    python -m benchmarks.imagined_strip FLIGHT --at 0.5 --out docs/imagined.png

The sticks are those that were flown, and in the last row the same with the yaw stick full right.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from mavbridge.commands.evaluate_imagination.flights import (
    FlightWindow,
    choose_windows,
    read_episode,
    with_images,
)
from mavbridge.commands.imagine.run import load_model
from mavbridge.commands.imagine.sampling import Sampler
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.records import FloatArray, ImageArray
from policy.contract import ACTION_NAMES

STEPS = (1, 4, 8, 16)
SCALE = 2
MARGIN_PX, HEADER_PX, LABEL_PX = 4, 22, 128


def strip(sampler: Sampler, window: FlightWindow, images: dict[int, ImageArray]) -> ImageArray:
    """Rows of frames [H, W, 3]: real, imagined, copied, and imagined with another stick."""
    now, dt_s = sampler.config.context_frames - 1, sampler.config.frame_dt_s
    turned: FloatArray = window.actions.copy()
    turned[:, ACTION_NAMES.index("yaw")] = 1.0
    rows = {
        "real": [images[now + step] for step in STEPS],
        "imagined": imagine(sampler, window, images, window.actions),
        "copy last": [images[now]] * len(STEPS),
        "yaw full right": imagine(sampler, window, images, turned),
    }
    side = sampler.config.image_size * SCALE
    pitch = side + MARGIN_PX
    height, width = HEADER_PX + len(rows) * pitch, LABEL_PX + len(STEPS) * pitch
    canvas = np.full((height, width, 3), 255, np.uint8)
    for column, step in enumerate(STEPS):
        _write(canvas, f"{step * dt_s:.1f} s", LABEL_PX + column * pitch, HEADER_PX - 7)
    for row, (name, frames) in enumerate(rows.items()):
        top = HEADER_PX + row * pitch
        _write(canvas, name, 4, top + side // 2)
        for column, frame in enumerate(frames):
            left = LABEL_PX + column * pitch
            large = cv2.resize(frame, (side, side), interpolation=cv2.INTER_NEAREST)
            canvas[top : top + side, left : left + side] = large
    return canvas


def imagine(
    sampler: Sampler, window: FlightWindow, images: dict[int, ImageArray], actions: FloatArray
) -> list[ImageArray]:
    """The frames at ``STEPS`` that follow from sticks [frames, 4]."""
    context = sampler.config.context_frames
    past = sampler.encode(np.stack([images[step] for step in range(context)]))[None]
    imagined = sampler.sample(past, window.states[None, :context], actions, seed=0)
    return list(sampler.decode(imagined.latents[[step - 1 for step in STEPS]]))


def _write(canvas: ImageArray, text: str, left_px: int, baseline_px: int) -> None:
    at = (left_px, baseline_px)
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (60, 60, 60), 1, cv2.LINE_AA)


def main() -> None:
    """Draw one window of one flight."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("flight", type=Path, help="a flight that the model was not trained on")
    parser.add_argument("--at", type=float, default=0.5, help="where in it, 0 to 1")
    parser.add_argument("--world-model", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    model = load_model(args.world_model, ddim_steps=4, device="cpu")
    sampler = Sampler(model, ddim_steps=4, decode_all=False, clock=MonotonicClock())
    config = sampler.config
    every, _ = choose_windows(
        [read_episode(args.flight, config)], config, steps=config.frames, count=1_000_000
    )
    if not every:
        parser.error(
            f"{args.flight} is too short: {config.frames * config.frame_dt_s:g} s and more"
        )
    chosen = every[round(args.at * (len(every) - 1))]
    steps = range(config.context_frames + config.frames)
    window, images = next(with_images([chosen], steps, config.image_size))
    cv2.imwrite(
        str(args.out), strip(sampler, window, images)[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9]
    )


if __name__ == "__main__":
    main()
