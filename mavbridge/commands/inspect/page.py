"""Page of ``mavbridge inspect --html``: one file with the figures, the plots and the video."""

import html
import json
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from mavbridge.commands.inspect.analysis import FlightAnalysis
from mavbridge.commands.inspect.series import FloatColumn
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.files import write_output
from mavbridge.flight.outcome import describe
from mavbridge.observe.report_table import number
from mavbridge.observe.viewer.layout import action_title

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
    return json.dumps([_flight(flight) for flight in flights], allow_nan=False).replace(
        "<", "\\u003c"
    )


def _flight(flight: FlightAnalysis) -> dict[str, Any]:
    series = flight.series
    return {
        "name": str(flight.folder),
        "outcome": _outcome(flight),
        "facts": list(_facts(flight)),
        "end_s": float(series.t_s[-1]) if len(series.t_s) else 0.0,
        "t": _packed(series.t_s),
        "plots": [plot for plot in _plots(flight) if plot["series"]],
        "holders": [asdict(span) | {"reason": str(span.reason or "")} for span in flight.holders],
        "moments": [asdict(moment) for moment in flight.moments],
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
    sticks, action, vision = report.sticks, report.action, report.vision
    yield "policy", f"{report.policy} on {report.engine}, {report.mode} rate", False
    yield "vehicle", report.autopilot or "none", False
    yield "when", f"{meta.started_at}, {report.duration_s:.1f} s", False
    if meta.crash is not None:
        yield "crashed", meta.crash, True
    if meta.loss is not None:
        yield "recording", meta.loss, True
    for text in flight.damage:
        yield "damage", text, True
    if meta.gates_passed is not None:
        yield "course", f"{meta.gates_passed} gates passed", meta.success is False
    missed = (
        f"{sticks.missed_slots} of {sticks.slots} slots missed, {sticks.coasting_sends} coasting"
    )
    yield "sticks", f"{flight.stick_hz:g} Hz grid, {missed}", sticks.missed_slots > 0
    late, shown = f"{action.late_chunks} late", f"{vision.frames} in all"
    for name, loop, rest in (("chunks", action, late), ("images", vision, shown)):
        is_slow = loop.rate_hz is not None and loop.rate_hz < 0.9 * loop.target_hz
        yield name, f"{number(loop.rate_hz, 1)} of {loop.target_hz:.4g} Hz, {rest}", is_slow
    for name, measured in flight.times_ms:
        if measured is not None:
            p50, p99 = f"p50 {measured.p50:.2f}", f"p99 {measured.p99:.2f}"
            yield name, f"{p50}, {p99}, most {measured.max:.2f} ms", False
    for cause, count in flight.causes:
        yield "delayed", f"{cause} ({count})", False


def _plots(flight: FlightAnalysis) -> Iterator[dict[str, Any]]:
    series = flight.series
    is_sticks = series.action_names == ("throttle", "yaw", "pitch", "roll")
    for axis, name in enumerate(series.action_names):
        columns = {
            ECHO: series.echo[:, axis] if is_sticks else np.array([np.nan]),
            "raw": series.raw[:, axis],
            "smoothed": series.smoothed[:, axis],
            "sent": series.sent[:, axis],
        }
        span = {"range": [-1.08, 1.08]} if is_sticks else {}
        title = f"Stick: {name}" if is_sticks else action_title(name)
        yield _plot(title, "", columns) | span
    ages = {"feature": series.feature_age_ms, "attitude": series.state_age_ms}
    ages_ms: dict[str, float] = {}
    if (limits := flight.limits) is not None:
        ages_ms = {
            "feature limit": limits.feature_ns / NS_PER_MS,
            "attitude limit": limits.state_ns / NS_PER_MS,
        }
    yield _plot("Age when sent", "ms", ages, ages_ms) | {"fromZero": True}
    if np.nanmax(series.lateness_ms, initial=0.0) > 0:  # none in simulated time
        lateness = {"sticks after their slot": series.lateness_ms}
        missed_ms = {"missed": NS_PER_S / NS_PER_MS / flight.stick_hz}
        yield _plot("Lateness", "ms", lateness, missed_ms) | {"fromZero": True}
    for title, unit, names, values in (
        ("Velocity", "m/s", ("north", "east", "down"), series.velocity_ned_mps),
        ("Attitude", "deg", ("roll", "pitch", "yaw"), series.roll_pitch_yaw_deg),
        ("Body rates", "deg/s", ("roll", "pitch", "yaw"), series.rate_frd_dps),
    ):
        yield _plot(title, unit, dict(zip(names, values.T, strict=True)))
    yield _plot("Height above the origin", "m", {"height": -series.position_ned_m[:, 2]})


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
    images = flight.images
    if not len(images.exposed_s):
        return None
    name, size, contract = images.video.name, images.video.stat().st_size, flight.meta.contract
    if contract is not None and contract.is_depth:
        return {"note": f"{name} holds depth, which browsers do not play: see it by --rerun"}
    if size > MAX_VIDEO_BYTES:
        told = f"{name} has {size / 1e6:.0f} MB, too much for a page"
        return {"note": f"{told}: open it beside it"}
    data = b64encode(images.video.read_bytes()).decode()
    return {
        "source": f"data:video/mp4;base64,{data}",
        "exposed_s": _packed(images.exposed_s),
    }
