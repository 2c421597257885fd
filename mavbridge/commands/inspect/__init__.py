"""``mavbridge inspect``: recorded flights on the terminal, in files and in the viewer."""

import heapq
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mavbridge.commands.config import InspectConfig
from mavbridge.commands.inspect.analysis import (
    FlightAnalysis,
    flight_facts,
    flight_findings,
    recorded_solves,
)
from mavbridge.commands.inspect.page import write_page
from mavbridge.commands.output import print_status, table_console, write_json
from mavbridge.core.errors import UserError
from mavbridge.core.files import require_writable
from mavbridge.core.records import Observed, Tick, VisionTick
from mavbridge.flight.history import ActionFrame
from mavbridge.flight.outcome import describe
from mavbridge.observe.terminal import timing_table
from mavbridge.observe.viewer import RerunView
from mavbridge.observe.viewer_layout import ViewedFlight
from mavbridge.observe.viewer_target import check_target
from mavbridge.recording.flight_folder import RecordedFlight

HOLDERS_SHOWN = 12
_SOURCES = {
    "flight": "a policy's flight",
    "demonstration": "a demonstration by the expert",
    "dagger": "a flight by the policy, with the expert's labels",
    "pilot": "a pilot's flight",
}


def print_flight(flight: FlightAnalysis, console: Console) -> None:
    """Print everything about one flight."""
    title = f": {_SOURCES[flight.meta.source]}, {flight.meta.started_at}"
    console.print(Text.assemble((str(flight.folder), "bold"), title))
    if flight.meta.outcome is not None:
        console.print(Text(describe(flight.meta.outcome)))
    for fact in flight_facts(flight):
        console.print(fact.line)
    if (table := timing_table(flight.report)) is not None:
        console.print(table)
    for finding in flight_findings(flight):
        console.print(finding.line)
    console.print(_holders_table(flight))
    console.print(_moments_table(flight))


def _holders_table(flight: FlightAnalysis) -> Table:
    spans = flight.holders
    is_expert = flight.meta.source == "demonstration"
    table = Table(title="Who held the sticks", title_justify="left")
    for name in ("from s", "to s"):
        table.add_column(name, justify="right")
    table.add_column("holder", no_wrap=True)
    table.add_column("why the policy did not fly")
    longest = sorted(spans, key=lambda span: span.start_s - span.end_s)[:HOLDERS_SHOWN]
    shown = sorted(longest, key=lambda span: span.start_s)
    for span in shown:
        holder = "expert" if is_expert and span.holder == "policy" else span.holder
        reason = Text(str(span.reason or ""))
        table.add_row(f"{span.start_s:.2f}", f"{span.end_s:.2f}", holder, reason)
    if len(shown) < len(spans):
        table.caption = f"the {len(shown)} longest of {len(spans)}"
    return table


def _moments_table(flight: FlightAnalysis) -> Table | Text:
    if not flight.moments:
        return Text("no moment went wrong", style="green")
    table = Table(title="The worst moments, the worst one first", title_justify="left")
    table.add_column("s", justify="right")
    table.add_column("what", no_wrap=True)
    table.add_column("what happened")
    for moment in flight.moments:
        table.add_row(f"{moment.t_s:.2f}", moment.what, Text(moment.detail))
    return table


BATCH_EVENTS = 25
"""One fifth of a second: the path in the viewer grows by batches."""


def inspect(flights: Sequence[Path], config: InspectConfig) -> int:
    """Report on flights, one after the other; on the page they are side by side."""
    if not flights:
        raise UserError("name a flight: mavbridge inspect DIR")
    if config.rerun != "off" and len(flights) > 1:
        raise UserError("--rerun shows one flight: name only that one")
    require_writable(config.html, "--html")
    require_writable(config.json, "--json")
    check_target(config.rerun)
    analyses = [FlightAnalysis(folder, gates=config.gates) for folder in flights]
    console = table_console()
    for flight in analyses:
        print_flight(flight, console)
    write_json(config.json, [as_document(flight) for flight in analyses])
    if config.html is not None:
        write_page(config.html, analyses)
        print_status(f"wrote {config.html}")
    if config.rerun != "off":
        show_in_viewer(analyses[0], config.rerun)
    return 0


def as_document(flight: FlightAnalysis) -> dict[str, object]:
    """Return the figures of a flight for ``--json``; null: not measured."""
    return {
        "folder": str(flight.folder),
        "damage": flight.damage,
        "stick_hz": flight.stick_hz,
        "report": flight.report,
        "image_latency_ms": flight.image_latency_ms,
        "causes": dict(flight.causes),
        "holders": flight.holders,
        "moments": flight.moments,
    }


def show_in_viewer(flight: FlightAnalysis, target: str) -> None:
    """Send the whole recording to the viewer for live flights."""
    meta, contract, limits = flight.meta, flight.meta.contract, flight.limits
    view = RerunView(
        target,
        ViewedFlight(
            vision_hz=meta.visual_hz,
            chunk_hz=meta.action_hz,
            stick_hz=flight.stick_hz,
            contract=contract,
            max_state_age_ns=limits.state_ns,
            max_feature_age_ns=limits.feature_ns,
            to_ned=ActionFrame(contract).to_guard,
            gates=flight.gates,
        ),
    )
    with closing(view):
        events = _events(flight)
        while batch := list(islice(events, BATCH_EVENTS)):
            view.consume(batch)


def _events(flight: FlightAnalysis) -> Iterator[Observed]:
    """Yield ticks, solves, and the images of all cameras, in the order of time."""
    ticks: Iterator[Observed] = (row.tick for row in flight.recorded.tick_rows())
    images = [_images(recorded, camera) for camera, recorded in enumerate(flight.cameras.values())]
    return heapq.merge(ticks, recorded_solves(flight.recorded), *images, key=_at_ns)


def _at_ns(event: Observed) -> int:
    if isinstance(event, Tick):
        return event.woke_ns
    return event.ready_ns if isinstance(event, VisionTick) else event.computed_ns


def _images(recorded: RecordedFlight, camera: int) -> Iterator[Observed]:
    """Yield the images; stand-ins fill the start of the encoding and the drops, not recorded."""
    pairs = zip(recorded.frame_rows(), recorded.images(), strict=True)
    for serial, (row, image) in enumerate(pairs):
        yield VisionTick(
            serial=serial,
            frame_id=row.frame_id,
            captured_ns=row.captured_ns,
            started_ns=row.captured_ns,
            ready_ns=row.ready_ns,
            dropped_frames=0,
            rgb=image,
            camera=camera,
        )
