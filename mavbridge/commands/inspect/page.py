"""Page of ``mavbridge inspect --html``: one file with the figures, the plots and the video."""

import html
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from mavbridge.commands.inspect.analysis import (
    FlightAnalysis,
    FloatColumn,
    flight_facts,
    flight_findings,
)
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.files import as_json, write_output
from mavbridge.core.vehicle import ACTION_CLASSES, ActionKind
from mavbridge.flight.outcome import describe
from mavbridge.observe.terminal import BAD, POOR
from mavbridge.observe.viewer_layout import action_title
from policy.adapters.interface import EULER_NAMES, state_values
from policy.contract import RATE, STATE_NAMES, VELOCITY
from policy.data.tables import vectors_or_nan
from policy.motion.rotation import other_frame

MAX_VIDEO_BYTES = 40_000_000
"""A larger video stays beside the page: larger data URLs make browsers slow."""
ECHO = "vehicle's echo"
ECHO_WIDTH, LINE_WIDTH = 5.0, 1.4
"""In pixels. The echo is drawn under the sticks, and is visible on both sides if they agree."""
_HERE = files("mavbridge.commands.inspect")


def write_page(path: Path, flights: Sequence[FlightAnalysis]) -> None:
    """Write one page with the flights side by side, which needs no other file and no network."""
    title = "mavbridge: " + " and ".join(flight.folder.name for flight in flights)
    text = _HERE.joinpath("page.html").read_text(encoding="utf-8")
    for name, value in (
        ("title", html.escape(title)),
        ("css", _HERE.joinpath("page.css").read_text(encoding="utf-8")),
        ("script", _HERE.joinpath("page.js").read_text(encoding="utf-8")),
        ("data", page_data(flights)),
    ):
        text = text.replace("{{" + name + "}}", value)
    write_output(path, text, "--html")


def page_data(flights: Sequence[FlightAnalysis]) -> str:
    """Return the JSON in the page. It contains no ``<``, so that no name can end its element."""
    return as_json([_flight(flight) for flight in flights]).replace("<", "\\u003c")


def _flight(flight: FlightAnalysis) -> dict[str, Any]:
    t_s = (flight.ticks["woke_ns"].to_numpy() - flight.start_ns) / NS_PER_S
    return {
        "name": str(flight.folder),
        "outcome": _outcome(flight),
        "facts": list(_facts(flight)),
        "end_s": float(t_s[-1]) if len(t_s) else 0.0,
        "t": _packed(t_s),
        "plots": [plot for plot in _plots(flight) if plot["series"]],
        "holders": [asdict(span) | {"reason": str(span.reason or "")} for span in flight.holders],
        "moments": flight.moments,
        "track": _track(flight),
        "gates": [gate._asdict() for gate in flight.gates],
        "video": _video(flight),
    }


def _outcome(flight: FlightAnalysis) -> dict[str, str] | None:
    """Return how the flight ended, and whether that is good; None if it is unknown."""
    meta, outcome = flight.meta, flight.meta.outcome
    if outcome is None:
        return None
    is_bad = outcome.crash is not None or outcome.end == "fault" or meta.success is False
    is_done = outcome.end in ("course", "stopped", "duration", "landed") or meta.success is True
    verdict = "bad" if is_bad else "good" if is_done else "plain"
    return {"text": describe(outcome), "verdict": verdict}


def _facts(flight: FlightAnalysis) -> Iterator[tuple[str, str, bool]]:
    """Yield label, text, and True if the fact is bad news."""
    report, meta = flight.report, flight.meta
    yield "policy", f"{report.policy} on {report.engine}, {report.mode} rate", False
    yield "vehicle", report.autopilot or "none", False
    yield "when", f"{meta.started_at}, {report.duration_s:.1f} s", False
    for finding in (*flight_facts(flight), *flight_findings(flight)):
        yield finding.name, finding.text, finding.style in (POOR, BAD)
    for name, measured in flight.times_ms.items():
        if measured is not None:
            p50, p99 = f"p50 {measured.p50:.2f}", f"p99 {measured.p99:.2f}"
            yield name, f"{p50}, {p99}, most {measured.max:.2f} ms", False


def _plots(flight: FlightAnalysis) -> Iterator[dict[str, Any]]:
    """Yield the plots of all N ticks, in NED and FRD for any policy; NaN for missing values."""
    contract = flight.meta.contract
    yield from _action_plots(flight.ticks, contract.action)
    yield from _timing_plots(flight)
    state = vectors_or_nan(flight.ticks["state"]).astype(np.float64)
    if contract.state_frame == "enu_flu":
        state = other_frame(state)
    angles_rad = np.stack(state_values(list(state.T), STATE_NAMES, EULER_NAMES), axis=-1)
    for title, unit, names, values in (
        ("Velocity", "m/s", ("north", "east", "down"), state[:, VELOCITY]),
        ("Attitude", "deg", ("roll", "pitch", "yaw"), np.degrees(angles_rad)),
        ("Body rates", "deg/s", ("roll", "pitch", "yaw"), np.degrees(state[:, RATE])),
    ):
        yield _plot(title, unit, dict(zip(names, values.T, strict=True)))
    height_m = -vectors_or_nan(flight.ticks["position_ned_m"])[:, 2]
    yield _plot("Height above the origin", "m", {"height": height_m})


def _action_plots(ticks: pa.Table, action: ActionKind) -> Iterator[dict[str, Any]]:
    """Yield a plot for each number of the actions, from the policy to the message."""
    is_sticks = action == "sticks"
    stages = {name: vectors_or_nan(ticks[name]) for name in ("raw", "smoothed", "sent")}
    if is_sticks:  # the echo of other actions is none of theirs
        stages = {ECHO: vectors_or_nan(ticks["rc_sticks"])} | stages
    for axis, name in enumerate(ACTION_CLASSES[action]._fields):
        title = f"Stick: {name}" if is_sticks else action_title(name)
        plot = _plot(title, "", {stage: values[:, axis] for stage, values in stages.items()})
        yield plot | ({"range": [-1.08, 1.08]} if is_sticks else {})


def _timing_plots(flight: FlightAnalysis) -> Iterator[dict[str, Any]]:
    """Yield the ages of what the sticks are based on, and the lateness of their sends."""
    ticks, limits = flight.ticks, flight.limits
    is_flown = ticks["raw"].is_valid()
    is_slot = pc.and_(is_flown, pc.fill_null(ticks["is_slot"], False))

    def before_send_ms(earlier: str, where: pa.ChunkedArray = is_flown) -> FloatColumn:
        lasted_ns = pc.subtract(ticks["sent_ns"], ticks[earlier])
        return np.asarray(pc.if_else(where, lasted_ns, None), np.float64) / NS_PER_MS

    ages = {
        "feature": before_send_ms("feature_captured_ns"),
        "attitude": before_send_ms("attitude_ns"),
    }
    limits_ms = {
        "feature limit": limits.feature_ns / NS_PER_MS,
        "attitude limit": limits.state_ns / NS_PER_MS,
    }
    yield _plot("Age when sent", "ms", ages, limits_ms) | {"fromZero": True}
    lateness_ms = np.maximum(before_send_ms("due_ns", is_slot), 0.0)
    if np.nanmax(lateness_ms, initial=0.0) > 0:  # none in simulated time
        lateness = {"sticks after their slot": lateness_ms}
        missed_ms = {"missed": NS_PER_S / NS_PER_MS / flight.stick_hz}
        yield _plot("Lateness", "ms", lateness, missed_ms) | {"fromZero": True}


def _plot(
    title: str,
    unit: str,
    columns: dict[str, FloatColumn],
    limits: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Return a plot of the columns that have any value, with limits by name."""
    known = {name: values for name, values in columns.items() if np.isfinite(values).any()}
    return {
        "title": title,
        "unit": unit,
        "limits": [{"name": name, "value": value} for name, value in (limits or {}).items()],
        "series": [
            {
                "name": name,
                "values": _packed(values),
                "width": ECHO_WIDTH if name == ECHO else LINE_WIDTH,
            }
            for name, values in known.items()
        ],
    }


def _packed(values: FloatColumn) -> str:
    """Encode as little-endian float32 in base64, which a script reads without rounding."""
    return b64encode(values.astype("<f4").tobytes()).decode()


def _track(flight: FlightAnalysis) -> dict[str, str] | None:
    if (track := flight.track) is None:
        return None
    columns = dict(zip(("north", "east", "down"), track.position_ned_m.T, strict=True))
    return {name: _packed(each) for name, each in ({"t": track.t_s} | columns).items()}


def _video(flight: FlightAnalysis) -> dict[str, Any] | None:
    """Return the video, or a note why it is not in the page; None without images."""
    recorded, contract = flight.recorded, flight.meta.contract
    exposed_ns, video = recorded.frames["captured_ns"].to_numpy(), flight.folder / recorded.video
    if not len(exposed_ns):
        return None
    name, size = video.name, video.stat().st_size
    if contract.is_depth:
        return {"note": f"{name} holds depth, which browsers do not play: see it by --rerun"}
    if size > MAX_VIDEO_BYTES:
        told = f"{name} has {size / 1e6:.0f} MB, too much for a page"
        return {"note": f"{told}: open it beside it"}
    data = b64encode(video.read_bytes()).decode()
    return {
        "source": f"data:video/mp4;base64,{data}",
        "exposed_s": _packed((exposed_ns - flight.start_ns) / NS_PER_S),
    }
