"""``mavbridge inspect`` from its arguments to its exit status."""

import heapq
import json
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict
from itertools import islice
from pathlib import Path

from mavbridge.commands.config import InspectConfig
from mavbridge.commands.inspect.analysis import FlightAnalysis, analyse
from mavbridge.commands.inspect.delays import flown_limits, recorded_solves
from mavbridge.commands.inspect.page import write_page
from mavbridge.commands.inspect.tables import print_comparison, print_flight
from mavbridge.commands.output import print_status, table_console
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.files import require_writable
from mavbridge.core.reasons import reason_to_json
from mavbridge.core.records import Observed, Solve, Tick, VisionTick
from mavbridge.flight.action_frames import action_frame
from mavbridge.observe.timing import report_document
from mavbridge.observe.viewer.flight import RerunView
from mavbridge.observe.viewer.layout import ViewedFlight
from mavbridge.observe.viewer.target import check_target
from mavbridge.recording.flight_folder import RecordedFlight, open_flight
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
    check_target(config.rerun)
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
            "damage": flight.damage,
            "stick_hz": flight.stick_hz,
            "report": report_document(flight.report),
            "image_latency_ms": {
                images.camera: images.latency_ms and asdict(images.latency_ms)
                for images in flight.cameras
            },
            "causes": dict(flight.causes),
            "holders": [
                asdict(span) | {"reason": span.reason and reason_to_json(span.reason)}
                for span in flight.holders
            ],
            "moments": [asdict(moment) for moment in flight.moments],
        }
        for flight in analyses
    ]
    return json.dumps(documents, indent=2, allow_nan=False) + "\n"


def show_in_viewer(flight: FlightAnalysis, target: str) -> None:
    """Send the whole recording to the viewer of live flights."""
    meta, contract = flight.meta, flight.meta.contract or Contract()
    limits = flown_limits(flight.folder, meta.contract)
    view = RerunView(
        target,
        ViewedFlight(
            vision_hz=meta.visual_hz,
            chunk_hz=meta.action_hz,
            stick_hz=flight.stick_hz,
            contract=contract,
            max_state_age_s=None if limits is None else limits.state_ns / NS_PER_S,
            max_feature_age_s=None if limits is None else limits.feature_ns / NS_PER_S,
            to_ned=action_frame(contract).to_guard,
            gates=flight.gates,
        ),
    )
    with closing(view):
        events = _events(flight.folder, meta.contract)
        while batch := list(islice(events, BATCH_EVENTS)):
            view.consume(batch)


def _events(folder: Path, contract: Contract | None) -> Iterator[Observed]:
    """Ticks, solves, and the images of all cameras, in the order of time."""
    first = open_flight(folder)
    others = () if contract is None else contract.cameras[1:]
    cameras = [first, *(open_flight(folder, name) for name in others)]
    ticks: Iterator[Observed] = (row.tick for row in first.tick_rows())
    images = [_images(recorded, number) for number, recorded in enumerate(cameras)]
    return heapq.merge(ticks, recorded_solves(folder, contract), *images, key=_at_ns)


def _at_ns(event: Observed) -> int:
    match event:
        case Tick():
            return event.woke_ns
        case VisionTick():
            return event.ready_ns
        case Solve():
            return event.computed_ns


def _images(recorded: RecordedFlight, camera: int) -> Iterator[Observed]:
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
            camera=camera,
        )
