"""Reasons as values: why the policy does not fly or has lost control, or why a flight ended.

Code branches on ``Reason.code``, recordings store it and tests compare it. The sentence,
``str(reason)``, is for people only.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum, StrEnum, auto
from typing import TypeAlias

Value: TypeAlias = "str | int | float | bool | Reason"


class Kind(Enum):
    """Party responsible for a reason."""

    WAITING = "waiting"
    """None: something has not arrived yet, or was not requested."""
    PILOT = "pilot"
    """The pilot or an operator, by an explicit act."""
    VEHICLE = "vehicle"
    """The autopilot or its link."""
    FAULT = "fault"
    """mavbridge itself: the policy, its inputs, this computer."""
    END = "end"
    """A planned end."""


class Code(StrEnum):
    """Identifier of a reason; ``_REASONS`` holds its kind and its sentence."""

    # Before a flight
    NOT_ENGAGED = auto()
    NOT_ENGAGED_SINCE = auto()
    STILL_ENDING = auto()
    SWITCH_NOT_RESTED = auto()
    NOT_ARMED = auto()
    WRONG_MODE = auto()
    FIRST_CHUNK = auto()
    TAKEOFF_NEEDS_POSITION = auto()
    TAKING_OFF = auto()
    WAITING_FOR_MODE = auto()
    WAITING_FOR_ARMING = auto()
    NO_SUCH_MODE = auto()
    NO_CHUNK_SINCE_RESET = auto()
    NOT_READY = auto()
    # Takeovers
    OPERATOR = auto()
    ENGAGE_SWITCH_OFF = auto()
    OVERRIDE_SWITCH_OFF = auto()
    MODE_CHANGED = auto()
    DISARMED = auto()
    FAILSAFE = auto()
    OVERRULED = auto()
    REBOOTED = auto()
    CLOCK_SET_BACK = auto()
    MOVED = auto()
    MOVED_AT_REST = auto()
    REPLACED = auto()
    PARAMETER_CHANGED = auto()
    # Planned ends
    DURATION = auto()
    SIGNAL = auto()
    COURSE_DONE = auto()
    POLICY_STOPPED = auto()
    LANDED = auto()
    TOLD_TO_END = auto()
    FINISHED = auto()
    PILOT_FLIES = auto()
    # Safe mode and release
    THEN = auto()
    VEHICLE_LOST = auto()
    MODE_NOT_CONFIRMED = auto()
    RELEASE_NOT_SEEN = auto()
    NOT_RELEASED = auto()
    NO_RECEIVER = auto()
    RECEIVER_LOST = auto()
    SILENCE_IS_FAILSAFE = auto()
    THROTTLE_IS_THRUST = auto()
    THROTTLE_UNKNOWN = auto()
    THROTTLE_RESTS = auto()
    # The link and the vehicle
    NO_POLICY_LOADED = auto()
    CONNECTION_LOST = auto()
    NO_HEARTBEAT = auto()
    HEARTBEAT_LOST = auto()
    PACKETS_REFUSED = auto()
    UNHEARD = auto()
    NO_ECHO = auto()
    LATE_SENDING = auto()
    READING_PARAMETERS = auto()
    REQUESTING_TELEMETRY = auto()
    LOOKING_FOR_RECEIVER = auto()
    SETTING_PARAMETERS = auto()
    SET_NEEDS_DISARMING = auto()
    SET_ABSENT = auto()
    SET_UNANSWERED = auto()
    SET_REFUSED = auto()
    CALIBRATION_UNUSABLE = auto()
    OBSTACLE = auto()
    CALIBRATION_CHANGED = auto()
    RISK = auto()
    ENDLESS_OVERRIDE = auto()
    NO_THROTTLE_FAILSAFE = auto()
    LONG_SETPOINT = auto()
    SLOW_SERIAL = auto()
    OVERRIDE_SWITCH_NOT_ON = auto()
    WITH_HINT = auto()
    SLOW_CLOCK = auto()
    VEHICLE_SIGNS = auto()
    # The envelope
    BEYOND = auto()
    ESTIMATOR_LOST = auto()
    BATTERY = auto()
    BATTERY_BELOW = auto()
    # The policy, its inputs and this computer
    LATE = auto()
    PAST_HORIZON = auto()
    TOO_OLD = auto()
    AFTER_HORIZON = auto()
    HORIZON_TOO_SHORT = auto()
    TOO_SLOW = auto()
    CHUNKS_APART = auto()
    CHUNKS_BEYOND_PLAN = auto()
    NO_CHUNK = auto()
    NOT_RECORDED = auto()
    JUST_BEGUN = auto()
    EMPTY_CHUNK = auto()
    WRONG_KIND = auto()
    NOT_FINITE = auto()
    WRONG_SHAPE = auto()
    UNUSABLE_CHUNKS = auto()
    POLICY_REFUSED = auto()
    NO_READING = auto()
    NO_TRUSTED_READING = auto()
    READING_AHEAD = auto()
    ATTITUDE_FROZEN = auto()
    NO_IMAGE = auto()
    IMAGE_AHEAD = auto()
    IMAGE_FROZEN = auto()
    IMAGE_BLANK = auto()
    OF_CAMERA = auto()
    COMMAND_FAILED = auto()
    CAMERA_FAILED = auto()
    POLICY_FAILED = auto()
    HANGS = auto()
    GUARD_DIED = auto()
    FLIGHT_PROCESS_DIED = auto()


_WAITING, _PILOT, _VEHICLE, _FAULT, _END = Kind
_REASONS: dict[Code, tuple[Kind, str]] = {
    Code.NOT_ENGAGED: (_WAITING, "not engaged: press e, use the engage switch, or --arm"),
    Code.NOT_ENGAGED_SINCE: (_WAITING, "not engaged: {why}"),
    Code.STILL_ENDING: (_WAITING, "the last flight is still ending ({phase})"),
    Code.SWITCH_NOT_RESTED: (
        _WAITING,
        "the engage switch (channel {channel}) did not rest low for {rest_s:g} s with a receiver "
        "that works: leave it low for 2 s, then switch it on",
    ),
    Code.NOT_ARMED: (_WAITING, "the vehicle is disarmed; arm it first, or use --arm"),
    Code.WRONG_MODE: (
        _WAITING,
        "the policy may not fly in {mode}, only in {allowed}: change the mode, or use --mode",
    ),
    Code.FIRST_CHUNK: (_WAITING, "waiting for the policy's first chunk after its reset"),
    Code.TAKEOFF_NEEDS_POSITION: (
        _WAITING,
        "waiting for a position: the autopilot's own takeoff needs one",
    ),
    Code.TAKING_OFF: (_WAITING, "taking off to {height_m:g} m"),
    Code.WAITING_FOR_MODE: (_WAITING, "waiting for {mode}"),
    Code.WAITING_FOR_ARMING: (_WAITING, "waiting for the vehicle to arm"),
    Code.NO_SUCH_MODE: (_VEHICLE, "this vehicle has no mode {mode}, it has {modes}"),
    Code.NO_CHUNK_SINCE_RESET: (
        _FAULT,
        "the policy has not returned a usable chunk since its reset: {why}",
    ),
    Code.NOT_READY: (
        _VEHICLE,
        "the vehicle is not ready after {after_s:.0f} s (mode {mode}, armed {is_armed}, overrides "
        "seen {is_echoed}, inputs {inputs}): see its messages above",
    ),
    Code.OPERATOR: (_PILOT, "released by the operator"),
    Code.ENGAGE_SWITCH_OFF: (_PILOT, "the pilot's engage switch is off (channel {channel})"),
    Code.OVERRIDE_SWITCH_OFF: (_PILOT, "the pilot's override switch is off"),
    Code.MODE_CHANGED: (_PILOT, "mode changed from {before} to {after}"),
    Code.DISARMED: (_VEHICLE, "the vehicle has been disarmed"),
    Code.FAILSAFE: (_VEHICLE, "a failsafe of the vehicle is active (mode {mode})"),
    Code.OVERRULED: (_PILOT, "the vehicle ignores our {quantity}"),
    Code.CLOCK_SET_BACK: (_VEHICLE, "the vehicle's clock went back by {back_s:.1f} s"),
    Code.MOVED: (_VEHICLE, "the vehicle now sends from {now} instead of {before}"),
    Code.REBOOTED: (_VEHICLE, "the vehicle has rebooted: its session starts over"),
    Code.MOVED_AT_REST: (
        _VEHICLE,
        "the vehicle now sends from {now} instead of {before}: its session starts over",
    ),
    Code.REPLACED: (
        _VEHICLE,
        "the vehicle at {before} is silent, and system {system} is now heard from {now}, which is "
        "not followed in flight: if it is another vehicle, give it another system id, or keep it "
        "off this port; if this one has moved, engage again",
    ),
    Code.PARAMETER_CHANGED: (
        _PILOT,
        "{name} was changed from {before:g} to {after:g} in flight",
    ),
    Code.DURATION: (_END, "the flight is over"),
    Code.SIGNAL: (_END, "the flight was ended by a signal"),
    Code.COURSE_DONE: (_END, "the course is done"),
    Code.POLICY_STOPPED: (_END, "the policy has stopped"),
    Code.LANDED: (_END, "the vehicle has landed"),
    Code.TOLD_TO_END: (_END, "the guard was told to end"),
    Code.FINISHED: (_END, "the {what} is over"),
    Code.PILOT_FLIES: (_PILOT, "the pilot flies"),
    Code.THEN: (_FAULT, "{first}; then {then}"),
    Code.VEHICLE_LOST: (_VEHICLE, "the vehicle was lost for {after_s:.0f} s"),
    Code.MODE_NOT_CONFIRMED: (_VEHICLE, "the vehicle has not confirmed {mode} in time"),
    Code.RELEASE_NOT_SEEN: (
        _VEHICLE,
        "the release was not seen: the vehicle still shows our last sticks, as it does without a "
        "receiver, or with one at rest in the same position",
    ),
    Code.NOT_RELEASED: (_VEHICLE, "{instead} instead of release in the air: {why}"),
    Code.NO_RECEIVER: (_VEHICLE, "there is no receiver"),
    Code.RECEIVER_LOST: (_VEHICLE, "the receiver is lost"),
    Code.SILENCE_IS_FAILSAFE: (
        _VEHICLE,
        "the vehicle takes the end of our sticks for a failsafe",
    ),
    Code.THROTTLE_IS_THRUST: (_VEHICLE, "in {mode} the throttle is thrust"),
    Code.THROTTLE_UNKNOWN: (_VEHICLE, "the receiver's throttle is not known"),
    Code.THROTTLE_RESTS: (
        _VEHICLE,
        "the receiver's throttle rests at {percent:+.0f} % (limit {limit_percent:.0f} %)",
    ),
    Code.NO_POLICY_LOADED: (_WAITING, "no policy is loaded yet"),
    Code.CONNECTION_LOST: (_VEHICLE, "the connection to the vehicle is lost: reconnecting"),
    Code.NO_HEARTBEAT: (_WAITING, "waiting for the vehicle's heartbeat"),
    Code.HEARTBEAT_LOST: (_VEHICLE, "the vehicle's heartbeat is lost"),
    Code.PACKETS_REFUSED: (
        _FAULT,
        "this computer has refused every packet to the vehicle for {after_ms:.0f} ms: no route, a "
        "firewall, or a full queue",
    ),
    Code.UNHEARD: (_VEHICLE, "the vehicle does not hear our {quantity}"),
    Code.NO_ECHO: (_VEHICLE, "no {message} arrives, so our {quantity} cannot be checked"),
    Code.LATE_SENDING: (_VEHICLE, "our packets take {age_ms:.0f} ms or more to reach the vehicle"),
    Code.READING_PARAMETERS: (_WAITING, "reading the vehicle's parameters"),
    Code.REQUESTING_TELEMETRY: (_WAITING, "requesting telemetry from the vehicle"),
    Code.LOOKING_FOR_RECEIVER: (_WAITING, "looking for the pilot's radio receiver"),
    Code.SETTING_PARAMETERS: (_WAITING, "setting the vehicle's parameters"),
    Code.SET_NEEDS_DISARMING: (_WAITING, "--set waits until the vehicle is disarmed"),
    Code.SET_ABSENT: (
        _VEHICLE,
        "--set {name}={value:g}: the vehicle has sent no such parameter; check its name, then "
        "start again",
    ),
    Code.SET_UNANSWERED: (
        _VEHICLE,
        "the vehicle has not answered --set {name}={value:g}: set it with your ground station, or "
        "leave the flag out",
    ),
    Code.SET_REFUSED: (
        _VEHICLE,
        "the vehicle did not take --set {name}={value:g}: it stays at {stays:g}; set it with your "
        "ground station, or leave the flag out",
    ),
    Code.CALIBRATION_UNUSABLE: (_VEHICLE, "the vehicle's radio calibration is unusable: {cause}"),
    Code.OBSTACLE: (_VEHICLE, "the vehicle would {what}: {causes}"),
    Code.CALIBRATION_CHANGED: (
        _PILOT,
        "the vehicle's radio calibration was changed in flight: disarm to apply it",
    ),
    Code.RISK: (
        _VEHICLE,
        "{why}, or --set-config link.accept_risk={risk} to fly anyway",
    ),
    Code.ENDLESS_OVERRIDE: (
        _VEHICLE,
        "if this computer died, the vehicle would hold its last sticks for ever (RC_OVERRIDE_TIME "
        "is {time_s:g}): use --set RC_OVERRIDE_TIME=0.5",
    ),
    Code.NO_THROTTLE_FAILSAFE: (
        _VEHICLE,
        "no receiver was seen, and without its throttle failsafe (FS_THR_ENABLE is 0) the vehicle "
        "would hold its last sticks for ever if this computer died: use --set FS_THR_ENABLE=1",
    ),
    Code.LONG_SETPOINT: (
        _VEHICLE,
        "if this computer died, the vehicle would fly on with its last setpoint for {time_s:g} s "
        "({name}): use --set {name}=0.5",
    ),
    Code.SLOW_SERIAL: (
        _VEHICLE,
        "{baud} baud cannot carry the requested sticks and states ({needed:.0f} bit/s): "
        "use --connect with a serial port of {enough:.0f} baud or more on both sides or with a "
        "network link, or a lower rates.action",
    ),
    Code.OVERRIDE_SWITCH_NOT_ON: (
        _WAITING,
        "the override switch (RC{channel}) is off: switch it on to fly",
    ),
    Code.WITH_HINT: (_VEHICLE, "{first}; {hint}"),
    Code.SLOW_CLOCK: (
        _VEHICLE,
        "the vehicle's clock runs at {pace:.2g} of real time: the simulator is slow, not the link; "
        "let it run at 1 (its speedup, or a faster computer)",
    ),
    Code.VEHICLE_SIGNS: (
        _VEHICLE,
        "the vehicle signs its packets and may ignore ours: give its key by --signing-key-file",
    ),
    Code.BEYOND: (
        _FAULT,
        "{quantity} {value:.1f} {unit} is beyond {limit:g} {unit} (envelope.{quantity})",
    ),
    Code.ESTIMATOR_LOST: (_VEHICLE, "the vehicle's estimator has lost its position"),
    Code.BATTERY: (_VEHICLE, "the vehicle reports its battery as low or failed"),
    Code.BATTERY_BELOW: (
        _VEHICLE,
        "the battery is at {percent} %, below {limit:g} % (envelope.min_battery)",
    ),
    Code.LATE: (_FAULT, "{quantity} {age_ms:.0f} ms old (limit {limit_ms:.0f} ms)"),
    Code.PAST_HORIZON: (
        _FAULT,
        "{quantity} {age_ms:.0f} ms old (its horizon ends after {limit_ms:.0f} ms)",
    ),
    Code.TOO_OLD: (_FAULT, "the {quantity} is {age_ms:.0f} ms old, beyond {limit_ms:.0f} ms"),
    Code.AFTER_HORIZON: (
        _FAULT,
        "the chunk arrived after its horizon of {horizon_ms:.3g} ms ({steps} x {step_ms:.3g} ms) "
        "had ended",
    ),
    Code.HORIZON_TOO_SHORT: (
        _FAULT,
        "the policy's horizon of {horizon_ms:.3g} ms ({steps} x {step_ms:.3g} ms) is too short for "
        "its rate: a chunk ends {covered_ms:.0f} ms after its arrival, and chunks arrive "
        "{gap_ms:.0f} ms apart; use a higher rates.single or rates.action, or a policy with a "
        "longer horizon",
    ),
    Code.TOO_SLOW: (
        _FAULT,
        "the policy is too slow for this computer, or the link for the policy: the last {chunks} "
        "chunks came too late, the newest {age_ms:.0f} ms after its attitude, which may be at most "
        "{limit_ms:.0f} ms old when an action is sent; use a smaller policy, fewer steps or a "
        "faster computer",
    ),
    Code.CHUNKS_APART: (
        _FAULT,
        "the policy is too slow for its rate on this computer: its chunks arrive up to "
        "{gap_ms:.0f} ms apart, and at most {bridged_ms:.0f} ms can be bridged; use a lower rate",
    ),
    Code.CHUNKS_BEYOND_PLAN: (
        _FAULT,
        "the policy's chunks arrive up to {gap_ms:.0f} ms apart, and its age limits and horizon "
        "allow at most {bridged_ms:.0f} ms; use a higher rate",
    ),
    Code.NO_CHUNK: (_WAITING, "no chunk from the policy yet"),
    Code.NOT_RECORDED: (_FAULT, "the recording lacks {what}"),
    Code.JUST_BEGUN: (_WAITING, "the policy has only just started"),
    Code.EMPTY_CHUNK: (_FAULT, "the policy returned a chunk without actions"),
    Code.WRONG_KIND: (
        _FAULT,
        "the policy returned actions of a different kind than its contract names",
    ),
    Code.NOT_FINITE: (_FAULT, "the policy returned a value that is not finite"),
    Code.WRONG_SHAPE: (
        _FAULT,
        "the policy returned {shape} instead of [1, horizon, 4], with at most {most} actions",
    ),
    Code.UNUSABLE_CHUNKS: (
        _FAULT,
        "the policy returned {chunks} unusable chunks within a short time: {why}",
    ),
    Code.POLICY_REFUSED: (_FAULT, "{said}"),
    Code.NO_READING: (_WAITING, "no {quantity} from the vehicle yet"),
    Code.NO_TRUSTED_READING: (
        _WAITING,
        "no {quantity} from the vehicle yet, or none that it trusts",
    ),
    Code.READING_AHEAD: (
        _VEHICLE,
        "{quantity} is stamped {ahead_ms:.0f} ms ahead of the vehicle's clock",
    ),
    Code.ATTITUDE_FROZEN: (
        _VEHICLE,
        "the vehicle's attitude has been frozen for {age_ms:.0f} ms (limit {limit_ms:.0f} ms)",
    ),
    Code.NO_IMAGE: (_WAITING, "no image feature yet"),
    Code.IMAGE_AHEAD: (
        _FAULT,
        "the camera stamps its images {ahead_ms:.0f} ms in the future (limit {limit_ms:.0f} ms): "
        "have it stamp them on CLOCK_MONOTONIC",
    ),
    Code.IMAGE_FROZEN: (_FAULT, "the image has been frozen for {age_s:.1f} s"),
    Code.IMAGE_BLANK: (_FAULT, "the image has been {what} for {age_s:.1f} s"),
    Code.OF_CAMERA: (_FAULT, "camera {camera}: {why}"),
    Code.COMMAND_FAILED: (
        _FAULT,
        "a command could not be encoded or sent, a bug in mavbridge: {error} ({place})",
    ),
    Code.CAMERA_FAILED: (_FAULT, "the camera{camera} or its encoder has failed"),
    Code.POLICY_FAILED: (_FAULT, "the policy has failed"),
    Code.HANGS: (_FAULT, "the {name} has hung for {idle_s:.1f} s"),
    Code.GUARD_DIED: (_FAULT, "the guard has died"),
    Code.FLIGHT_PROCESS_DIED: (_FAULT, "the flight process has died"),
}
_WRAPPERS = (Code.THEN, Code.WITH_HINT, Code.OF_CAMERA)
_CAUSES = {
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
_CAUSE_OF = ("output", "quantity")
"""Likely causes of ``OVERRULED`` and ``UNHEARD``, by one of these figures and ``fault``."""
_SPENT = {
    "computer": "the computer stood still for",
    "guard": "the guard stood still for",
    "flight process": "the flight process stood still, or solved, for",
    "solve": "the solve took",
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
    def kind(self) -> Kind:
        """Party responsible; that of the inner reason if this one only adds words."""
        inner = dict(self.data).get("first") or dict(self.data).get("why")
        if self.code in _WRAPPERS and isinstance(inner, Reason):
            return inner.kind
        return _REASONS[self.code][0]

    @property
    def codes(self) -> tuple[Code, ...]:
        """Code of this reason and of those inside it."""
        return tuple(self._codes())

    @property
    def key(self) -> tuple[object, ...]:
        """Key that is equal for reasons that differ only in numbers."""
        words = [
            value.key if isinstance(value, Reason) else value
            for _, value in self.data
            if isinstance(value, str | Reason)
        ]
        return self.code, *words

    def _codes(self) -> Iterator[Code]:
        yield self.code
        for _, value in self.data:
            if isinstance(value, Reason):
                yield from value.codes

    def __str__(self) -> str:
        """Return the sentence for the user."""
        words = dict(self.data)
        text = _REASONS[self.code][1].format(**words)
        if self.code in (Code.OVERRULED, Code.UNHEARD):
            keys = ((str(words.get(name)), str(words.get("fault"))) for name in _CAUSE_OF)
            return ": ".join((text, *(_CAUSES[key] for key in keys if key in _CAUSES)))
        if self.code not in (Code.LATE, Code.PAST_HORIZON):
            return text
        said, place = words.get("said"), words["place"]
        if said is not None and place == "flight process":  # it answers, so it does not stall
            return f"{said}; {text}"
        spent = _SPENT[str(place)].format(**words)
        text = f"{text}: {spent} {words['spent_ms']:.0f} ms"
        return text if said is None else f"{said}; {text}"


def because(code: Code, **data: Value) -> Reason:
    """Return the reason with this code and these figures."""
    return Reason(code, tuple(data.items()))


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
        Code(str(document["code"])),
        **{
            name: reason_from_json(value) if isinstance(value, dict) else value
            for name, value in data.items()
        },
    )
