"""A rollout in the Rerun viewer: imagined and real frames side by side, states and sticks.

Unlike in a flight's view, a slow viewer slows the rollout down, and errors of the viewer end it.
"""

from collections.abc import Callable

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mavbridge.core.records import ImageArray, RolloutFrame
from mavbridge.observe.viewer.layout import STICK_COLORS
from mavbridge.observe.viewer.target import RerunRecording
from policy.contract import ACTION_NAMES, QUATERNION, RATE, SPECIFIC_FORCE, STATE_NAMES, VELOCITY

IMAGINED, REAL, STICKS = "imagined", "real", "sticks"
STATES = {
    "state/velocity": ("World velocity [m/s]", VELOCITY),
    "state/attitude": ("Attitude, world from body", QUATERNION),
    "state/rate": ("Body rates [rad/s]", RATE),
    "state/force": ("Specific force [m/s^2]", SPECIFIC_FORCE),
}


def rollout_blueprint() -> rrb.Blueprint:
    """Return the initial layout of the viewer."""
    plots = [
        rrb.TimeSeriesView(origin=path, name=name, plot_legend=rrb.PlotLegend(corner="LeftTop"))
        for path, name in [(STICKS, "Sticks"), *((path, STATES[path][0]) for path in STATES)]
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Horizontal(
                    rrb.Spatial2DView(origin=IMAGINED, name="Imagined"),
                    rrb.Spatial2DView(origin=REAL, name="Real, at the same time"),
                ),
                plots[0],
                row_shares=[2, 1],
            ),
            rrb.Vertical(*plots[1:]),
        ),
        rrb.TimePanel(state="collapsed", timeline="frame"),
        collapse_panels=True,
    )


class RolloutView:
    """Shows frames as they come, on the timelines ``frame`` (in the video) and ``time``.

    If iterations overlap, ``time`` goes back with each, and the viewer shows the last one.
    """

    def __init__(self, target: str, *, real: Callable[[int], ImageArray | None]) -> None:
        """Open the file or the viewer; raise the errors of ``prepare_target``.

        ``real`` returns the camera's real image at a step, [H, W, 3], or None.
        """
        self._real = real
        self._recording = RerunRecording("mavbridge-rollout", target)
        self._recording.open(rollout_blueprint())
        lines = {path: rr.SeriesLines(names=STATE_NAMES[at]) for path, (_, at) in STATES.items()}
        colors = [STICK_COLORS[name] for name in ACTION_NAMES]
        lines[STICKS] = rr.SeriesLines(names=ACTION_NAMES, colors=colors)
        for path, style in lines.items():
            self._recording.stream.log(path, style, static=True, strict=True)

    def show(self, frame: RolloutFrame, rgb: ImageArray | None) -> None:
        """Send one frame; blocks while the viewer does not keep up. Call from one thread."""
        recording = self._recording.stream
        recording.set_time("frame", sequence=frame.number)
        recording.set_time("time", duration=frame.time_s)
        if rgb is not None:
            recording.log(IMAGINED, _png(rgb), strict=True)
        real = self._real(frame.step)
        # After the flight's end there is no real image; the last one must not stay.
        recording.log(REAL, rr.Clear(recursive=False) if real is None else _png(real), strict=True)
        recording.log(STICKS, rr.Scalars(frame.action), strict=True)
        for path, (_, columns) in STATES.items():
            recording.log(path, rr.Scalars(frame.state[columns]), strict=True)

    def close(self) -> None:
        """Deliver the rest and block until taken; raise MavbridgeError if the viewer is gone."""
        self._recording.close()


def _png(rgb: ImageArray) -> rr.EncodedImage:
    """Encode losslessly: these images are small, and people judge their quality."""
    _, encoded = cv2.imencode(".png", cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2BGR))
    return rr.EncodedImage(contents=encoded.tobytes(), media_type="image/png")
