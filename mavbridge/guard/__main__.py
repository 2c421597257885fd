"""Guard process: ``python -m mavbridge.guard FD FD``, started by the flight process.

Its settings come on standard input. Messages and errors go through the channel (the first file
descriptor), the vehicle's readings through the second. It prints nothing, since a reader of its
output might block it, but for a line to a terminal whose flight process has died.
"""

import os
import signal
import socket
import sys
import traceback
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path

from mavbridge.core.clock import NS_PER_MS, MonotonicClock
from mavbridge.core.errors import MavbridgeError, PeerError, UserError
from mavbridge.core.realtime import settle_guard
from mavbridge.core.reasons import Code, because
from mavbridge.guard.channel import SocketPort
from mavbridge.guard.loop import GuardLoop
from mavbridge.guard.values import EndRequest, GuardOutcome, GuardSettings
from mavbridge.guard.wire import GuardDiedError, GuardSummary, encode, read_settings
from mavbridge.mavlink.codec.tlog import PacketPipe
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.transport.signing_files import SigningStore
from mavbridge.mavlink.transport.sockets import make_transport

SUMMARY_S = 2.0
"""Longest wait [s] for a busy flight process to read the last message; control is given back."""
LEAD_NS = 150 * NS_PER_MS // 1000
"""Time from the decision to its slot [ns]: the least time that the work before a send takes.
A chunk that arrives in between waits for the slot, so a longer lead would delay chunks."""
_UNBLOCKED = os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK
_SURVIVED = ("SIGINT", "SIGHUP", "SIGTSTP", "SIGTTIN", "SIGTTOU")
"""Terminal signals that end or stop the flight process, and that the guard ignores."""


def main() -> None:
    """Serve one flight process until control has been given back."""
    for name in _SURVIVED:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    ends = [socket.socket(fileno=int(fd)) for fd in sys.argv[1:]]
    port, samples = SocketPort(ends[0], peer_pid=os.getppid()), SocketPort(ends[1])
    settings = read_settings(sys.stdin.buffer)
    try:
        with ExitStack() as stack:
            _run(settings, port, samples, stack)
    except MavbridgeError as error:
        kind = UserError if isinstance(error, UserError) else PeerError
        port.finish(encode(kind(str(error))), SUMMARY_S)
        sys.exit(1)
    except Exception:  # noqa: BLE001 - the flight process shows it
        failed = f"the guard process has failed, a bug of mavbridge:\n{traceback.format_exc()}"
        port.finish(encode(GuardDiedError(failed)), SUMMARY_S)
        sys.exit(2)


def _run(settings: GuardSettings, port: SocketPort, samples: SocketPort, stack: ExitStack) -> None:
    clock, log, signing, problem = MonotonicClock(), None, None, None
    if settings.link.signing is not None:
        signing = stack.enter_context(store := SigningStore(settings.link.signing, clock))
        problem = store.problem
    if settings.tlog_fd is not None:
        log = PacketPipe(settings.tlog_fd, wall_offset_ns=settings.wall_offset_ns)
    transport = make_transport(settings.link.connect, clock)
    link = MavlinkLink(
        transport,
        clock,
        settings.link,
        packet_log=log,
        keeps_packets=settings.keeps_packets,
        signing=signing,
    )
    loop = GuardLoop(clock, link, port, samples=samples, lead_ns=LEAD_NS)
    with suppress(OSError):  # there is no /proc on macOS
        loop.say = partial(say_on, Path(f"/proc/{os.getppid()}/fd/2").readlink())
    told = EndRequest(reason=because(Code.TOLD_TO_END))
    signal.signal(signal.SIGTERM, lambda *_: loop.stop(told))
    # After the link is open: the first message tells the flight process so.
    for text in (problem, settle_guard(realtime=settings.realtime)):
        if text is not None:
            port.send(encode(text))
    try:
        loop.run(port)
    except BaseException:
        loop.abandon()
        raise
    finally:
        link.close()
    summary = GuardSummary(
        link=link.stats(),
        outcome=loop.guard.engagement.outcome if loop.guard else GuardOutcome(),
        params=dict(link.known_params),
        dropped_messages=port.dropped + samples.dropped,
        dropped_packets=log.dropped if log else 0,
    )
    port.finish(encode(summary), SUMMARY_S)


def say_on(terminal: Path, text: str) -> None:
    """Write a line to a terminal, and show its cursor again; nothing if that would block."""
    plain = "".join(letter if letter.isprintable() else "?" for letter in text)
    with suppress(OSError), os.fdopen(os.open(terminal, _UNBLOCKED), "wb", buffering=0) as stream:
        if stream.isatty():
            stream.write(f"\r\n{plain}\r\n\x1b[?25h".encode())


if __name__ == "__main__":
    main()
