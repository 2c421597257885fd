"""``mavbridge inspect`` from its arguments to its exit status."""

import heapq
import json
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict
from itertools import islice
from pathlib import Path

from mavbridge.commands.inspect.analysis import FlightAnalysis, analyse
from mavbridge.commands.inspect.config import InspectConfig
from mavbridge.commands.inspect.page import write_page
from mavbridge.commands.inspect.tables import print_comparison, print_flight
from mavbridge.commands.output import print_status, table_console
from mavbridge.core.errors import UserError
from mavbridge.core.files import require_writable
from mavbridge.core.records import Observed, Tick, VisionTick
from mavbridge.flight.action_frames import action_frame
from mavbridge.observe.viewer.flight import RerunView
from mavbridge.observe.viewer.layout import ViewedFlight
from mavbridge.recording import replay_rows
from mavbridge.recording.flight_folder import RecordedFlight, open_flight
from mavbridge.recording.folder import SOLVES
from mavbridge.recording.tables import TableError, read_table
from policy.contract import Contract

MAX_FLIGHTS = 2
BATCH_EVENTS = 25
"""A fifth of a second: the path in the viewer grows by batches."""


def inspect(flights: Sequence[Path], config: InspectConfig) -> int:
    """Report on one flight, or compare two.

    Raises:
        MavbridgeError: a flight cannot be read, or an output cannot be written.
    """
    if not 1 <= len(flights) <= MAX_FLIGHTS:
        raise UserError(f"name one flight, or two to compare, not {len(flights)}")
    if config.rerun != "off" and len(flights) > 1:
        raise UserError("--rerun shows one flight: name only that one")
    require_writable(config.html, "--html")
    require_writable(config.json, "--json")
    analyses = [analyse(folder, gates=config.gates) for folder in flights]
    console = table_console()
    if len(analyses) == 1:
        print_flight(analyses[0], console)
    else:
        print_comparison(analyses, console)
    if config.json is not None:
        config.json.write_text(to_json(analyses))
    if config.html is not None:
        write_page(config.html, analyses)
        print_status(f"wrote {config.html}")
    if config.rerun != "off":
        show_in_viewer(analyses[0], config.rerun)
    return 0


def to_json(analyses: Sequence[FlightAnalysis]) -> str:
    """The figures, one object a flight; null = not measured."""
    documents = [
        {
            "folder": str(flight.folder),
            "stick_hz": flight.stick_hz,
            "report": asdict(flight.report),
            "image_latency_ms": flight.images.latency_ms and asdict(flight.images.latency_ms),
            "causes": dict(flight.causes),
            "holders": [asdict(span) for span in flight.holders],
            "moments": [asdict(moment) for moment in flight.moments],
        }
        for flight in analyses
    ]
    return json.dumps(documents, indent=2, allow_nan=False) + "\n"


def show_in_viewer(flight: FlightAnalysis, target: str) -> None:
    """Send the whole recording to the viewer of live flights."""
    meta, contract = flight.meta, flight.meta.contract or Contract()
    view = RerunView(
        target,
        ViewedFlight(
            vision_hz=meta.visual_hz,
            chunk_hz=meta.action_hz,
            stick_hz=flight.stick_hz,
            contract=contract,
            max_state_age_s=contract.max_state_age_s + contract.play_s,
            max_feature_age_s=contract.max_feature_age_s + contract.play_s,
            to_ned=action_frame(contract).to_gate,
            gates=flight.gates,
        ),
    )
    with closing(view):
        events = _events(flight.folder)
        while batch := list(islice(events, BATCH_EVENTS)):
            view.consume(batch)


def _events(folder: Path) -> Iterator[Observed]:
    """Ticks, solves and images of the first camera in the order of time."""
    recorded = open_flight(folder)
    ticks: Iterator[Observed] = (row.tick for row in recorded.tick_rows())
    return heapq.merge(ticks, _solves(recorded), _images(recorded), key=_at_ns)


def _at_ns(event: Observed) -> int:
    if isinstance(event, Tick):
        return event.woke_ns
    return event.ready_ns if isinstance(event, VisionTick) else event.computed_ns


def _solves(recorded: RecordedFlight) -> Iterator[Observed]:
    """None where the recording holds none: no policy flew, or it is an old one."""
    if recorded.meta.contract is None:
        return
    try:
        table = read_table(recorded.folder / SOLVES, replay_rows.SOLVES)
    except TableError:
        return
    for row in replay_rows.read_solves(table, recorded.meta.contract):
        yield row.solve


def _images(recorded: RecordedFlight) -> Iterator[Observed]:
    dropped = 0
    pairs = zip(recorded.frame_rows(), recorded.images(), strict=True)
    for serial, (row, image) in enumerate(pairs):
        dropped += row.dropped_before
        yield VisionTick(
            serial=serial,
            frame_id=row.frame_id,
            captured_ns=row.captured_ns,
            started_ns=row.captured_ns,
            ready_ns=row.ready_ns,
            dropped_frames=dropped,
            rgb=image,
        )
