"""Reasons as values: why the policy does not fly or has lost control, or why a flight ended.

Code branches on ``Reason.code``, recordings store it and tests compare it. The sentence,
``str(reason)``, is for people only.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, StrEnum, auto
from functools import partial
from itertools import chain
from typing import Any, Self, TypeAlias

from mavbridge.core.clock import NS_PER_MS

Value: TypeAlias = "str | int | float | bool | Reason"


class Kind(Enum):
    """Party responsible for a reason."""

    WAITING = "waiting"
    """Nobody: something has not arrived yet, or was not requested."""
    PILOT = "pilot"
    """The pilot or an operator, by an explicit act."""
    VEHICLE = "vehicle"
    """The autopilot or its link."""
    FAULT = "fault"
    """mavbridge itself: the policy, its inputs, this computer."""
    END = "end"
    """A planned end."""


def _member(kind: Kind, sentence: str) -> Any:
    return auto(), kind, sentence


_waiting, _pilot, _vehicle, _fault, _end = (partial(_member, kind) for kind in Kind)


class Code(StrEnum):
    """Identifier of a reason, with its kind and the format of its sentence."""

    kind: Kind
    sentence: str

    def __new__(cls, value: str, kind: Kind, sentence: str) -> Self:
        """Return the member; ``value`` is its name in lower case."""
        member = str.__new__(cls, value)
        member._value_, member.kind, member.sentence = value, kind, sentence
        return member

    # Before a flight
    NOT_ENGAGED = _waiting("not engaged: press e, use the engage switch, or --arm")
    NOT_ENGAGED_SINCE = _waiting("not engaged: {why}")
    STILL_ENDING = _waiting("the last flight is still ending ({phase})")
    ENTERED_LATE = _waiting("the vehicle has entered {mode} late, by our request: change its mode")
    SWITCH_NOT_RESTED = _waiting(
        "the engage switch (channel {channel}) did not rest low for {rest_s:g} s with a receiver "
        "that works: leave it low for 2 s, then switch it on"
    )
    ENGAGE_SWITCH_UNSEEN = _vehicle(
        "no reading of the engage switch (channel {channel}) for {limit_s:g} s: look at the radio "
        "and at RC_CHANNELS, or start without --engage-channel"
    )
    ARMED_UNSEEN = _waiting(
        "the vehicle was armed before it was found, or while it was silent: press e"
    )
    NOT_ARMED = _waiting("the vehicle is disarmed; arm it first, or use --arm")
    WRONG_MODE = _waiting(
        "the policy may not fly in {mode}, only in {allowed}: change the mode, or use --mode"
    )
    FIRST_CHUNK = _waiting("waiting for the policy's first chunk after its reset")
    TAKEOFF_NEEDS_POSITION = _waiting(
        "waiting for a position: the autopilot's own takeoff needs one"
    )
    TAKING_OFF = _waiting("taking off to {height_m:g} m")
    WAITING_FOR_MODE = _waiting("waiting for {mode}")
    WAITING_FOR_ARMING = _waiting("waiting for the vehicle to arm")
    NO_SUCH_MODE = _vehicle("this vehicle has no mode {mode}, it has {modes}")
    NO_CHUNK_SINCE_RESET = _fault(
        "the policy has not returned a usable chunk since its reset: {why}"
    )
    NOT_READY = _vehicle(
        "the vehicle is not ready after {after_s:.0f} s (mode: {mode}; armed: {is_armed}; shows "
        "our sticks: {is_echoed}; inputs: {inputs}): see its messages above"
    )
    # Takeovers
    OPERATOR = _pilot("released by the operator")
    ENGAGE_SWITCH_OFF = _pilot("the pilot's engage switch is off (channel {channel})")
    OVERRIDE_SWITCH_OFF = _pilot("the pilot's override switch is off")
    MODE_CHANGED = _pilot("mode changed from {before} to {after}")
    DISARMED = _vehicle("the vehicle has been disarmed")
    FAILSAFE = _vehicle("a failsafe of the vehicle is active (mode {mode})")
    OVERRULED = _pilot("the vehicle ignores our {quantity}")
    REBOOTED = _vehicle("the vehicle has rebooted: its session starts over")
    CLOCK_SET_BACK = _vehicle("the vehicle's clock went back by {back_s:.1f} s")
    MOVED = _vehicle("the vehicle now sends from {now} instead of {before}")
    MOVED_AT_REST = _vehicle(
        "the vehicle now sends from {now} instead of {before}: its session starts over"
    )
    REPLACED = _vehicle(
        "the vehicle at {before} is silent, and system {system} is now heard from {now}, which is "
        "not followed in flight: if it is another vehicle, give it another system id, or keep it "
        "off this port; if this one has moved, engage again"
    )
    PARAMETER_CHANGED = _pilot("{name} was changed from {before:g} to {after:g} in flight")
    # Planned ends
    DURATION = _end("the flight is over")
    SIGNAL = _end("the flight was ended by a signal")
    COURSE_DONE = _end("the course is done")
    POLICY_STOPPED = _end("the policy has stopped")
    LANDED = _end("the vehicle has landed")
    TOLD_TO_END = _end("the guard was told to end")
    FINISHED = _end("the {what} is over")
    PILOT_FLIES = _pilot("the pilot flies")
    # Safe mode and release
    THEN = _fault("{first}; then {then}")
    VEHICLE_LOST = _vehicle("the vehicle was lost for {after_s:.0f} s")
    MODE_NOT_CONFIRMED = _vehicle("the vehicle has not confirmed {mode} in time")
    RELEASE_NOT_SEEN = _vehicle(
        "the release was not seen: the vehicle still shows our last sticks, as it does without a "
        "receiver, or with one at rest in the same position"
    )
    NOT_RELEASED = _vehicle("{instead} instead of release: {why}")
    NO_RECEIVER = _vehicle("there is no receiver")
    RECEIVER_LOST = _vehicle("the receiver is lost")
    SILENCE_IS_FAILSAFE = _vehicle("the vehicle takes the end of our sticks for a failsafe")
    THROTTLE_IS_THRUST = _vehicle("in {mode} the throttle is thrust")
    THROTTLE_UNKNOWN = _vehicle("the receiver's throttle is not known")
    THROTTLE_RESTS = _vehicle(
        "the receiver's throttle rests at {percent:+.0f} % (limit {limit_percent:.0f} %)"
    )
    # The link and the vehicle
    NO_POLICY_LOADED = _waiting("no policy is loaded yet")
    CONNECTION_LOST = _vehicle("the connection to the vehicle is lost: reconnecting")
    NO_HEARTBEAT = _waiting("waiting for the vehicle's heartbeat")
    HEARTBEAT_LOST = _vehicle("the vehicle's heartbeat is lost")
    PACKETS_REFUSED = _fault(
        "this computer has refused every packet to the vehicle for {after_ms:.0f} ms: no route, a "
        "firewall, or a full queue"
    )
    UNHEARD = _vehicle("the vehicle does not hear our {quantity}")
    NO_ECHO = _vehicle("no {message} arrives: our {quantity} are not heard, or not shown")
    LATE_SENDING = _vehicle("our packets take {age_ms:.0f} ms or more to reach the vehicle")
    READING_PARAMETERS = _waiting(
        "reading the vehicle's parameters: if this lasts, check port, baud rate and signing"
    )
    REQUESTING_TELEMETRY = _waiting(
        "requesting telemetry from the vehicle: if this lasts, check what forwards its answers"
    )
    LOOKING_FOR_RECEIVER = _waiting("looking for the pilot's radio receiver")
    SETTING_PARAMETERS = _waiting("setting the vehicle's parameters")
    SET_NEEDS_DISARMING = _waiting("--set waits until the vehicle is disarmed")
    SET_ABSENT = _vehicle(
        "--set {name}={value:g}: the vehicle has sent no such parameter; check its name, then "
        "start again"
    )
    SET_UNANSWERED = _vehicle(
        "the vehicle has not answered --set {name}={value:g}: set it with your ground station, or "
        "leave the flag out"
    )
    SET_REFUSED = _vehicle(
        "the vehicle did not take --set {name}={value:g}: it holds {stays:g}; set it with your "
        "ground station, or leave the flag out"
    )
    CALIBRATION_UNUSABLE = _vehicle("the vehicle's radio calibration is unusable: {cause}")
    OBSTACLE = _vehicle("the vehicle would {what}: {causes}")
    CALIBRATION_CHANGED = _pilot(
        "the vehicle's radio calibration was changed in flight: disarm to apply it"
    )
    RISK = _vehicle("{why}, or --set-config link.accept_risk={risk} to fly anyway")
    ENDLESS_OVERRIDE = _vehicle(
        "if this computer died, the vehicle would hold its last sticks for ever (RC_OVERRIDE_TIME "
        "is {time_s:g}): use --set RC_OVERRIDE_TIME=0.5"
    )
    NO_THROTTLE_FAILSAFE = _vehicle(
        "no receiver was seen, and without its throttle failsafe (FS_THR_ENABLE is 0) the vehicle "
        "would hold its last sticks for ever if this computer died: use --set FS_THR_ENABLE=1"
    )
    LONG_SETPOINT = _vehicle(
        "if this computer died, the vehicle would fly on with its last setpoint for {time_s:g} s "
        "({name}): use --set {name}=0.5"
    )
    SLOW_SERIAL = _vehicle(
        "{baud} baud cannot carry the requested sticks and states ({needed:.0f} bit/s): "
        "use --connect with a serial port of {enough:.0f} baud or more on both sides or with a "
        "network link, or a lower rates.action"
    )
    OVERRIDE_SWITCH_NOT_ON = _waiting("override switch (RC{channel}) off: switch it on to fly")
    WITH_HINT = _vehicle("{first}; {hint}")
    SLOW_CLOCK = _vehicle(
        "the vehicle's clock runs at {pace:.2g} of real time: the simulator is slow, not the link; "
        "let it run at 1 (its speedup, or a faster computer)"
    )
    VEHICLE_SIGNS = _vehicle(
        "the vehicle signs its packets and may ignore ours: give its key by --signing-key-file"
    )
    # The envelope
    BEYOND = _fault(
        "{quantity} {value:.1f} {unit} is beyond {limit:g} {unit} (envelope.{quantity})"
    )
    ESTIMATOR_LOST = _vehicle("the vehicle's estimator has lost its position")
    BATTERY = _vehicle("the vehicle reports its battery as low or failed")
    BATTERY_BELOW = _vehicle(
        "the battery is at {percent} %, below {limit:g} % (envelope.min_battery)"
    )
    # The policy, its inputs and this computer
    LATE = _fault("{quantity} {age_ms:.0f} ms old (limit {limit_ms:.0f} ms)")
    PAST_HORIZON = _fault(
        "{quantity} {age_ms:.0f} ms old (its horizon ends after {limit_ms:.0f} ms)"
    )
    TOO_OLD = _fault("the {quantity} is {age_ms:.0f} ms old, beyond {limit_ms:.0f} ms")
    AFTER_HORIZON = _fault(
        "the chunk arrived after its horizon of {horizon_ms:.3g} ms ({steps} x {step_ms:.3g} ms) "
        "had ended"
    )
    HORIZON_TOO_SHORT = _fault(
        "the policy's horizon of {horizon_ms:.3g} ms ({steps} x {step_ms:.3g} ms) is too short for "
        "its rate: a chunk ends {covered_ms:.0f} ms after its arrival, and chunks arrive "
        "{gap_ms:.0f} ms apart; use a higher rates.single or rates.action, or a policy with a "
        "longer horizon"
    )
    TOO_SLOW = _fault(
        "the policy is too slow for this computer, or the link for the policy: the last {chunks} "
        "chunks came too late, the newest {age_ms:.0f} ms after its attitude, which may be at most "
        "{limit_ms:.0f} ms old when an action is sent; use a smaller policy, fewer steps or a "
        "faster computer"
    )
    CHUNKS_APART = _fault(
        "the policy is too slow for its rate on this computer: its chunks arrive up to "
        "{gap_ms:.0f} ms apart, and at most {bridged_ms:.0f} ms can be bridged; use a lower rate"
    )
    CHUNKS_BEYOND_PLAN = _fault(
        "the policy's chunks arrive up to {gap_ms:.0f} ms apart, and its age limits and horizon "
        "allow at most {bridged_ms:.0f} ms; use a higher rate"
    )
    CHUNKS_RESUMED = _waiting(
        "chunks have just resumed after a gap of {gap_ms:.0f} ms (limit {bridged_ms:.0f} ms): "
        "wait for steady chunks"
    )
    NO_CHUNK = _waiting("no chunk from the policy yet")
    NOT_RECORDED = _fault("the recording lacks {what}")
    JUST_BEGUN = _waiting("the policy has only just started")
    EMPTY_CHUNK = _fault("the policy returned a chunk without actions")
    WRONG_KIND = _fault("the policy returned actions of a different kind than its contract names")
    NOT_FINITE = _fault("the policy returned a value that is not finite")
    WRONG_SHAPE = _fault(
        "the policy returned {shape} instead of [1, {most}, 4], by its contract's horizon"
    )
    UNUSABLE_CHUNKS = _fault("the policy returned {chunks} unusable chunks in a short time: {why}")
    POLICY_REFUSED = _fault("{said}")
    NO_READING = _waiting("no new {quantity} from the vehicle")
    NO_TRUSTED_READING = _waiting("no {quantity} from the vehicle yet, or none that it trusts")
    READING_AHEAD = _vehicle("{quantity} is stamped {ahead_ms:.0f} ms ahead of the vehicle's clock")
    ATTITUDE_FROZEN = _vehicle(
        "the vehicle's attitude has been frozen for {age_ms:.0f} ms (limit {limit_ms:.0f} ms)"
    )
    NO_IMAGE = _waiting("no image feature yet")
    IMAGE_AHEAD = _fault(
        "the camera stamps its images {ahead_ms:.0f} ms in the future (limit {limit_ms:.0f} ms): "
        "have it stamp them on CLOCK_MONOTONIC"
    )
    IMAGE_FROZEN = _fault("the image has been frozen for {age_s:.1f} s")
    IMAGE_BLANK = _fault("the image has been {what} for {age_s:.1f} s")
    OF_CAMERA = _fault("camera {camera}: {why}")
    COMMAND_FAILED = _fault(
        "a command could not be encoded or sent, a bug in mavbridge: {error} ({place})"
    )
    CAMERA_FAILED = _fault("the camera{camera} or its encoder has failed")
    POLICY_FAILED = _fault("the policy has failed")
    HANGS = _fault("the {name} has hung for {idle_s:.1f} s")
    GUARD_DIED = _fault("the guard has died")
    FLIGHT_PROCESS_DIED = _fault("the flight process has died")
    UNREADABLE = _fault("the guard cannot read a message of the flight process: report this bug")


_WRAPPERS = (Code.THEN, Code.WITH_HINT, Code.OF_CAMERA)
_CAUSES: dict[tuple[object, object], str] = {
    ("rc-override", "unseen"): "another station may be overriding them, or the receiver has "
    "priority",
    ("rc-override", "foreign"): "another station is overriding them (a joystick on our system id?)",
    ("rc-override", "returned"): "it also follows the sticks that it had before ours: another "
    "station is overriding or releasing them, or the override switch is off",
    ("manual-control", "unseen"): "it follows other sticks (a receiver, or a joystick on another "
    "link) and keeps them (COM_RC_IN_MODE)",
    ("manual-control", "foreign"): "another station sends sticks, or the receiver has priority "
    "(COM_RC_IN_MODE)",
    ("manual-control", "returned"): "it also follows the sticks that it had before ours "
    "(COM_RC_IN_MODE)",
    ("setpoints", "unseen"): "another station may be commanding it",
    ("setpoints", "foreign"): "another station is commanding it too, or it limits or refuses them",
    ("setpoints", "returned"): "it has returned to the target that it had before ours",
    ("setpoints", "silent"): "its target has not changed for 0.4 s while ours has",
    ("sticks", "silent"): "its sticks have not moved for 0.4 s while ours have",
}
"""Likely causes of ``OVERRULED`` and ``UNHEARD``, by ``output`` or ``quantity``, and ``fault``."""
_SPENT: dict[object, str] = {
    "computer": "the computer stood still for",
    "guard": "the guard stood still for",
    "flight process": "the flight process stood still, or solved, for",
    "solve": "the solve took",
    "lag": "the link delays attitudes by",
    "link": "the link delivered no {quantity} for",
    "camera": "the camera delivered nothing for",
}
"""Phrases for the place that delayed an input, by ``place`` of ``LATE`` and ``PAST_HORIZON``."""


@dataclass(frozen=True, slots=True)
class Reason:
    """A code and its data: plain values, and figures named with their unit, such as ``age_ms``."""

    code: Code
    data: tuple[tuple[str, Value], ...] = ()

    @property
    def inner(self) -> list["Reason"]:
        """Reasons inside this one, in order."""
        return [value for _, value in self.data if isinstance(value, Reason)]

    @property
    def kind(self) -> Kind:
        """Party responsible; that of the inner reason if this one only adds words."""
        inner = self.inner
        return inner[0].kind if self.code in _WRAPPERS and inner else self.code.kind

    @property
    def codes(self) -> tuple[Code, ...]:
        """Code of this reason and of those inside it."""
        return (self.code, *chain.from_iterable(each.codes for each in self.inner))

    @property
    def key(self) -> tuple[object, ...]:
        """Key that is equal for reasons that differ only in numbers."""
        words = [
            value.key if isinstance(value, Reason) else value
            for _, value in self.data
            if isinstance(value, str | Reason)
        ]
        return self.code, *words

    def __str__(self) -> str:
        """Return the sentence for the user."""
        words = {
            name: ("no", "yes")[value] if isinstance(value, bool) else value
            for name, value in self.data
        }
        text = self.code.sentence.format(**words)
        if self.code in (Code.OVERRULED, Code.UNHEARD):
            keys = [(words.get(name), words.get("fault")) for name in ("output", "quantity")]
            return ": ".join((text, *(_CAUSES[key] for key in keys if key in _CAUSES)))
        if self.code in (Code.LATE, Code.PAST_HORIZON):
            said, place = words.get("said"), words["place"]
            if said is None or place != "flight process":  # one that answers does not stall
                text = f"{text}: {_SPENT[place].format(**words)} {words['spent_ms']:.0f} ms"
            return text if said is None else f"{said}; {text}"
        return text


def because(code: Code, **data: Value) -> Reason:
    """Return the reason with this code and these figures."""
    return Reason(code, tuple(data.items()))


def too_old(quantity: str, age_ns: int, limit_ns: int) -> Reason:
    """Return the reason not to act on an input of this age."""
    figures = {"age_ms": age_ns / NS_PER_MS, "limit_ms": limit_ns / NS_PER_MS}
    return because(Code.TOO_OLD, quantity=quantity, **figures)


def reason_to_json(reason: Reason, *, has_words: bool = True) -> dict[str, object]:
    """Return code and data for JSON; with ``has_words`` also the kind and the sentence."""
    data = {
        name: reason_to_json(value, has_words=has_words) if isinstance(value, Reason) else value
        for name, value in reason.data
    }
    document: dict[str, object] = {"code": reason.code.value, "data": data}
    if has_words:
        document |= {"kind": reason.kind.value, "text": str(reason)}
    return document


def reason_from_json(document: Mapping[str, object]) -> Reason:
    """Return the reason of a document of ``reason_to_json``.

    Raises:
        KeyError, TypeError, ValueError: it is malformed, or this version lacks its code.
    """
    data = document["data"]
    if not isinstance(data, dict):
        raise TypeError(f"data is {type(data).__name__}, not an object")
    return because(
        Code[str(document["code"]).upper()],
        **{
            name: reason_from_json(value) if isinstance(value, dict) else value
            for name, value in data.items()
        },
    )
