"""The latency of the link: clients in turn against one vehicle that times their answers."""

import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from mavbridge.commands.bench.link_vehicle import ATTITUDE_HZ, CONNECT_S, Answers
from mavbridge.commands.bench.results import OURS, ClientTiming, LinkLatency, from_json
from mavbridge.commands.output import print_status
from mavbridge.core.errors import UserError
from mavbridge.core.processes import end, free_port, log_tail, running, wait

LINK_PROCESS = "mavbridge.commands.bench.link_process"
LINK_VEHICLE = "mavbridge.commands.bench.link_vehicle"
STARTING_S = 15.0
"""For imports, beside what the vehicle gives a client to connect."""


@dataclass(frozen=True, kw_only=True)
class LinkClient:
    """A program that answers each attitude with sticks."""

    name: str
    command: tuple[str, ...]
    """``--port P`` is appended."""
    writes_timing: bool = False
    """Takes ``--out FILE``, too, and writes a ``ClientTiming`` there."""


OUR_CLIENT = LinkClient(name=OURS, command=(sys.executable, "-m", LINK_PROCESS), writes_timing=True)


def time_link(client: LinkClient, attitudes: int) -> LinkLatency:
    """Time one client.

    Raises:
        UserError: the client or the vehicle failed; quotes the end of both logs.
    """
    print_status(f"link: {client.name}")
    port = str(free_port())
    timeout_s = STARTING_S + CONNECT_S + 1.1 * attitudes / ATTITUDE_HZ
    with TemporaryDirectory(prefix="mavbridge-bench-") as name:
        folder = Path(name)
        log, vehicle_log = folder / "client.log", folder / "vehicle.log"
        timing, answers = folder / "timing.json", folder / "answers.json"
        own = ("--out", str(timing)) if client.writes_timing else ()
        vehicle_command = (
            *(sys.executable, "-m", LINK_VEHICLE, "--port", port),
            *("--attitudes", str(attitudes), "--out", str(answers)),
        )
        with (
            running(*client.command, "--port", port, *own, log=log) as process,
            running(*vehicle_command, log=vehicle_log) as vehicle,
        ):
            try:
                wait(vehicle, f"python -m {LINK_VEHICLE}", vehicle_log, timeout_s)
            except UserError as error:
                raise UserError(f"{client.name}: {error}\nits log: {log_tail(log)}") from error
            end(process)
        counted = from_json(Answers, answers.read_text())
        if counted.round_trip_ms is None:
            raise UserError(f"{client.name} answered no attitude; its log: {log_tail(log)}")
        return LinkLatency(
            client=client.name,
            sent=counted.sent,
            answered=counted.answered,
            round_trip_ms=counted.round_trip_ms,
            timing=from_json(ClientTiming, timing.read_text()) if own else ClientTiming(),
        )
