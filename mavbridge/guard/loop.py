"""The guard's loop: connects the guard to the vehicle's link and to the flight process."""

import select
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import TypeVar

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.ticks import GuardTick
from mavbridge.core.vehicle import (
    Action,
    LinkArrivals,
    LinkSnapshot,
    Outlet,
    Release,
    VehicleStatus,
)
from mavbridge.guard.channel import Port, SocketPort
from mavbridge.guard.chunks import Chunk
from mavbridge.guard.guard import Guard, GuardInput, GuardOutput
from mavbridge.guard.values import EndRequest, FlightSettings, OperatorCommand, Phase
from mavbridge.guard.wire import (
    NO_WORDS,
    GuardStatus,
    LastWords,
    Packets,
    Samples,
    decode_to_guard,
    encode,
)
from mavbridge.mavlink.link import MavlinkLink

IDLE_PERIOD_NS = 10 * NS_PER_MS
"""Polling period of the link before a policy is loaded."""
FINISH_NS = 4 * NS_PER_S
"""Longest time to restore parameters, and to send a delayed release, at the end."""
_Sent = TypeVar("_Sent")
WORDS_NS, THRUST_WORDS_NS = NS_PER_S, 100 * NS_PER_MS
"""Renewal periods of the last words, the packets that the flight process sends if the guard dies:
their signatures must be less than a minute old, and the choice of the safe mode may change. In
thrust modes they repeat the last throttle, which should be recent."""
_HELD = (Phase.FLYING, Phase.LEAVING, Phase.HOLDING)
_TAKEN = (*_HELD, Phase.RELEASING, Phase.PREPARING)
_MOTION = ("telemetry", "status", "position_ned_m")
_LINK, _STATUS = (
    attrgetter(*(each.name for each in fields(kind) if each.name not in _MOTION))
    for kind in (LinkSnapshot, VehicleStatus)
)
"""Getters of all fields that can cause a step of the guard, the vehicle's motion excluded."""


class GuardLoop:
    """Receives, decides, sends and reports in one pass per wakeup. Not thread-safe."""

    def __init__(
        self,
        clock: Clock,
        link: MavlinkLink,
        flight: Port,
        *,
        samples: Port | None = None,
        lead_ns: int = 0,
        watch_input: Callable[[int, GuardInput], object] = lambda at_ns, given: None,
    ) -> None:
        """Connect the link and the flight process.

        Args:
            clock: source of all timestamps.
            link: link to the vehicle.
            flight: channel to the flight process.
            samples: port for the vehicle's readings; None: send them through ``flight``.
            lead_ns: time from the start of a computation to its slot; the send waits for the slot.
            watch_input: called with the time and the input of each step of the guard.
        """
        self.say: Callable[[str], object] = lambda text: None
        """Called with the announcements that the flight process cannot show any more."""
        self._watch_input = watch_input
        self._lead_ns = lead_ns
        self._clock = clock
        self._link = link
        self._flight = flight
        self._samples = samples or flight
        self.guard: Guard | None = None
        """None until the flight's settings have come."""
        self._vehicle: VehicleStatus | None = None
        self._status: GuardStatus | None = None
        """Last status sent to the flight process."""
        self._phase = Phase.WAITING
        self._stop: EndRequest | None = None
        self._command_fault: Reason | None = None
        """Error of the last pass while a command was encoded or sent."""
        self._finish_until_ns: int | None = None
        self._is_clean = False
        self._words = NO_WORDS
        """Newest last words: packets that make the vehicle safe if this process dies."""
        self._words_basis: object = None
        self._words_due_ns = 0
        self._words_outlet: Outlet | None = None
        """Outlet that the flight process holds open."""
        self._known: object = None
        """State of the link and the vehicle at the guard's last step, motion excluded."""
        self._stepped_ns = 0
        """Time of the guard's last step."""
        self._reports = 0
        """Number of ticks sent to the flight process, with those that it did not take."""
        self.is_done = False
        """True once control has been given back and no further flight will follow."""

    def stop(self, ending: EndRequest) -> None:
        """End at the next step, as ``ending`` demands; the first request counts."""
        self._stop = self._stop or ending

    def abandon(self) -> None:
        """Send the last words without the state machine, after a bug in the guard.

        After each packet the flight process gets the rest: it kills a silent guard that holds the
        vehicle, and sends what it has.
        """
        with suppress(Exception):
            self._prepare_words(self._link.outlet)
        died_ns, packets = self._clock.now_ns(), self._words.packets
        for sent, (after_ns, packet) in enumerate(packets, 1):
            self._clock.sleep_until_ns(died_ns + after_ns)
            with suppress(Exception):
                self._link.transmit(packet)
            left = tuple((at_ns - after_ns, later) for at_ns, later in packets[sent:])
            with suppress(Exception):
                self._flight.send(encode(self._words._replace(packets=left)))

    def _renew_words(self, snapshot: LinkSnapshot, tick: GuardTick) -> None:
        """Prepare the last words when their inputs have changed, and periodically."""
        now_ns, status, outlet = self._clock.now_ns(), snapshot.status, self._link.outlet
        basis: tuple[object, ...] = (tick.phase, outlet)
        if status is not None:
            basis += (status.mode, status.armed, status.is_landed, status.has_receiver)
            basis += (status.is_position_valid,)
        is_old = tick.is_slot and now_ns >= self._words_due_ns
        if basis != self._words_basis or is_old:
            is_thrust = status is not None and status.mode in snapshot.modes.thrust
            self._words_due_ns = now_ns + (THRUST_WORDS_NS if is_thrust else WORDS_NS)
            self._words_basis = basis
            self._prepare_words(outlet)

    def _prepare_words(self, outlet: Outlet) -> None:
        """Give the flight process the packets to send if this process dies."""
        if self.guard is None:
            return
        is_held = self.guard.engagement.phase in _TAKEN and outlet.fd is not None
        plan = tuple(self.guard.rehearse()) if is_held else ()
        packets = self._link.rehearse(plan)
        if not (self._words.packets or packets):
            return
        mode = next((mode for _, _, mode in plan if mode is not None), None)
        is_new = bool(packets) and outlet != self._words_outlet
        words = LastWords(self.guard.engagement.phase, mode, outlet.receiver, is_new, packets)
        self._words = words._replace(brings_file=False)
        is_told = self._flight.send(encode(words), outlet.fd if is_new else None)
        self._words_outlet = outlet if is_told and packets else None

    def run(self, woken_by: SocketPort) -> None:
        """Step at every arrival and at every deadline until control has been given back.

        Args:
            woken_by: channel to the flight process, whose messages wake the loop like the link's.
        """
        while not self.is_done:
            due_ns = self.step()
            ends = (None if woken_by.is_closed else woken_by.fileno(), self._link.fileno())
            timeout_ns = due_ns - self._clock.now_ns()
            if timeout_ns > 0:
                readable = [end for end in ends if end is not None]
                select.select(readable, [], [], timeout_ns / NS_PER_S)

    def step(self) -> int:
        """Run one pass. Return the latest time of the next one.

        Raises:
            PeerError: the vehicle cannot be found.
            UserError: the vehicle cannot be flown.
        """
        # Samples leave at once: the policy solves while the guard looks at the rest. Packets may
        # arrive meanwhile: a replay receives those up to ``woke_ns``.
        woke_ns = max(self._clock.now_ns(), self._forward(self._link.receive()))
        snapshot = self._link.snapshot()
        self._report_vehicle(snapshot)
        given = self._receive(snapshot)
        if self.guard is None:
            self._link.service()
            if given.stop is not None:
                self._finish(woke_ns)
            return woke_ns + IDLE_PERIOD_NS
        # Compute for a slot that is about to come due, so that only the send is left.
        now_ns, slot_ns = self._clock.now_ns(), self.guard.next_ns
        at_ns = slot_ns if 0 < slot_ns - now_ns <= self._lead_ns else now_ns
        status = snapshot.status
        known = (_LINK(snapshot), status and _STATUS(status), self._link.outlet)
        if not self._has_work(known, given, at_ns, slot_ns):
            self._link.service()
            return self.guard.next_ns - self._lead_ns
        self._known, self._stepped_ns = known, at_ns
        self._watch_input(at_ns, given)
        output = self.guard.step(at_ns, given)
        wanted = output.decision
        is_action = not isinstance(wanted, Release | None)
        if is_action:
            self._link.send_before_action()
        if wanted is not None and at_ns > now_ns:
            self._clock.sleep_until_ns(at_ns)
        self._command_fault = None
        sent = None if wanted is None else self._attempt(partial(self._link.send, wanted, at_ns))
        if is_action and sent is None:
            self.guard.unsent()
        tick, phase = output.tick, self.guard.engagement.phase
        if tick.is_slot or wanted is not None or phase is not self._phase:
            self._report_tick(tick, woke_ns, sent)
        self._follow(output)
        if phase is not self._phase:
            self._change_phase(phase, tick.release_reason)
        self._link.service()
        self._renew_words(snapshot, tick)
        if phase is Phase.ENDED:
            self._finish(woke_ns)
        # After a failed command the next pass follows at once.
        return woke_ns if self._command_fault else self.guard.next_ns - self._lead_ns

    def _has_work(self, known: object, given: GuardInput, at_ns: int, slot_ns: int) -> bool:
        """True if the guard must step.

        In flight, between slots and within 10 ms of a step, motion alone is no reason.
        """
        is_called = given.chunk or given.absence or given.act or given.stop or given.command_fault
        is_due = at_ns >= min(slot_ns, self._stepped_ns + IDLE_PERIOD_NS)
        return self._phase is not Phase.FLYING or is_due or known != self._known or bool(is_called)

    def _report_tick(self, tick: GuardTick, woke_ns: int, sent: Action | None) -> None:
        told = replace(
            tick,
            serial=self._reports,
            due_ns=tick.due_ns if tick.is_slot else woke_ns,
            woke_ns=woke_ns,
            sent_ns=self._clock.now_ns(),
            sent=sent,
        )
        self._reports += 1
        self._flight.send(encode(told))

    def _attempt(self, send: Callable[[], _Sent]) -> _Sent | None:
        """Call ``send``. An error becomes a fault of the flight instead of ending the guard."""
        try:
            return send()
        except Exception as error:  # noqa: BLE001 - the vehicle is held: an orderly end
            at = traceback.extract_tb(error.__traceback__)[-1]
            self._command_fault = because(
                Code.COMMAND_FAILED,
                error=f"{type(error).__name__}: {error}",
                place=f"{Path(at.filename).name}:{at.lineno}",
            )
            return None

    def _follow(self, output: GuardOutput) -> None:
        """Send the requests to the vehicle, and the messages to the flight process."""
        commands, actions = self._link.commands, output.actions
        if actions.mode is not None:
            self._attempt(partial(commands.set_mode, actions.mode))
        if actions.arm:
            commands.arm()
        if actions.takeoff_m is not None:
            self._attempt(partial(commands.takeoff, actions.takeoff_m))
        for text in output.messages:
            self._flight.send(encode(text))

    def _finish(self, now_ns: int) -> None:
        """For at most FINISH_NS, restore parameters and send an outstanding release."""
        if self._finish_until_ns is None:
            self._finish_until_ns = now_ns + FINISH_NS
        was_clean, is_restored = self._is_clean, self._link.restore()
        self._is_clean = is_restored and not self._link.is_release_owed
        # One more pass forwards the link's messages about the parameters.
        self.is_done = (was_clean and self._is_clean) or now_ns >= self._finish_until_ns
        if self.is_done and not is_restored:
            late = (
                "what --set changed was not put back, as the vehicle did not answer within "
                f"{FINISH_NS / NS_PER_S:g} s: set the old values, which the log has, with your "
                "ground station"
            )
            self._flight.send(encode(late))

    def _forward(self, arrivals: LinkArrivals) -> int:
        """Pass samples and packets on. Return the arrival of the last packet, or 0."""
        # The flight process does not read samples before a policy is loaded; keep the queue free.
        if arrivals.samples and self.guard is not None:
            self._samples.send(encode(Samples(arrivals.samples)))
        if arrivals.packets and self.guard is not None:
            self._flight.send(encode(Packets(arrivals.packets)))
        return arrivals.packets[-1].arrived_ns if arrivals.packets else 0

    def _report_vehicle(self, snapshot: LinkSnapshot) -> None:
        """Send the vehicle's status if it has changed, and the link's texts."""
        vehicle = snapshot.status
        if vehicle is not self._vehicle or self._status is None or snapshot.texts:
            self._vehicle = vehicle
            self._report_status(vehicle)
        for text in snapshot.texts:
            self._flight.send(encode(text))

    def _report_status(self, vehicle: VehicleStatus | None) -> None:
        settings = None if self.guard is None else self.guard.settings
        watches_position = settings is not None and settings.watches_position
        status = GuardStatus(
            autopilot=self._link.autopilot,
            mode=vehicle.mode if vehicle else None,
            armed=vehicle is not None and vehicle.armed,
            is_landed=vehicle.is_landed if vehicle else None,
            # They change with each message, and nobody reads before a policy is loaded.
            rc_channels_us=vehicle.rc_channels_us if vehicle and settings else (),
            rc_sticks=vehicle.rc_sticks if vehicle and settings else None,
            has_position=watches_position and bool(vehicle and vehicle.position_ned_m),
        )
        if status != self._status:  # one that the channel did not take is sent again
            self._status = status if self._flight.send(encode(status)) else None

    def _receive(self, snapshot: LinkSnapshot) -> GuardInput:
        """Read the messages of the flight process; keep the newest of each kind."""
        chunk: Chunk | None = None
        absence: Reason | None = None
        act: OperatorCommand | None = None
        for data in self._flight.receive():
            try:
                message = decode_to_guard(data)
            except ValueError:
                if self._phase not in _TAKEN:
                    raise  # nobody is held, and the bug is told with its traceback
                self.stop(EndRequest(reason=because(Code.UNREADABLE), end="fault"))
                continue
            match message:
                case Chunk() as chunk:
                    absence = None
                case Reason() as absence:
                    pass
                case FlightSettings() as settings if self.guard is None:  # once
                    self.guard = Guard(settings, self._clock.now_ns())
                    self._link.begin_flight(
                        settings.meaning,
                        settings.output,
                        watches_home_height=settings.watches_home_height,
                    )
                case EndRequest() as ending:
                    self.stop(ending)
                case "engage" | "release" as new:
                    act = "release" if act == "release" else new  # release wins over a later engage
        if self._flight.is_closed:
            self.stop(EndRequest(reason=because(Code.FLIGHT_PROCESS_DIED), end="fault"))
        return GuardInput(
            link=snapshot,
            chunk=chunk,
            absence=absence,
            act=act,
            stop=self._stop,
            command_fault=self._command_fault,
        )

    def _change_phase(self, phase: Phase, reason: Reason | None) -> None:
        """Announce on the link who has control."""
        before, self._phase = self._phase, phase
        self._link.is_engaged = self._phase in _TAKEN
        text: str | None = None
        match self._phase:
            case Phase.FLYING:
                text = "the policy has control"
            case Phase.LEAVING:
                text = f"neutral: {reason}"
            case Phase.HOLDING if self.guard is not None:
                text = f"neutral sticks go on until {self.guard.ways_out}"
                self._flight.send(encode(text))
            case Phase.RELEASING | Phase.RELEASED if before in _HELD:
                text = f"control given back: {reason}"
        if text is not None:
            self._link.announce(f"mavbridge: {text}")
            if self._flight.is_closed:
                self.say(f"mavbridge: {text}")
