"""The exit status of a flight, and the sentence that explains it."""

import logging
import shlex
from pathlib import Path
from typing import NamedTuple

from mavbridge.core.errors import ExitCode
from mavbridge.core.stopping import StopRequest
from mavbridge.gate.wire import GateSummary

_log = logging.getLogger(__name__)


class Verdict(NamedTuple):
    """How a flight went, for scripts and for the user."""

    exit_code: int
    text: str | None = None
    """Why it is not 0."""


def flight_verdict(
    summary: GateSummary | None,
    stop: StopRequest,
    *,
    reason: str,
    readonly: bool,
    record: Path | None = None,
) -> Verdict:
    """Judge a flight that ended without an exception.

    Args:
        summary: the gate's last words; None where it goes on without us.
        stop: the signals that have come.
        reason: why the policy does not fly now, from the last tick.
        readonly: nothing was sent, so there was nothing to fly.
        record: folder of the recording, if there is one.
    """
    interrupted = None if stop.signal_number is None else 128 + stop.signal_number
    if summary is None:
        return Verdict(interrupted or ExitCode.NOT_FLOWN)
    outcome = summary.outcome
    if outcome.faults:
        shown = f"; see it with: mavbridge inspect {shlex.quote(str(record))}" if record else ""
        fault = f"the policy's flight was ended by a fault: {outcome.fault}{shown}"
        return Verdict(ExitCode.FAULT, fault)
    if readonly and outcome.flights:
        return Verdict(ExitCode.DONE)
    if not outcome.flights:
        why = f": {reason}" if reason else ""
        return Verdict(interrupted or ExitCode.NOT_FLOWN, f"the policy has not flown{why}")
    if outcome.has_left_ground is False:
        code = interrupted or ExitCode.NOT_FLOWN
        return Verdict(code, "the vehicle has not left the ground")
    if outcome.is_disarmed:
        text = "the vehicle was disarmed, or started anew, while the policy flew it"
        return Verdict(ExitCode.NOT_FLOWN, text)
    return Verdict(ExitCode.DONE)


def log_link(summary: GateSummary) -> None:
    """Log what came over the link, and the parameters that were read."""
    rates = (f"{name} {rate_hz:.1f}" for name, rate_hz in summary.link.messages_per_s)
    _log.debug("received, in Hz: %s", ", ".join(rates))
    params = (f"{name}={value:g}" for name, value in sorted(summary.params.items()))
    _log.debug("parameters: %s", ", ".join(params))
