"""What the engagement is told once, and what it remembers from step to step."""

from dataclasses import dataclass, field

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.switch import Switch
from mavbridge.guard.sequences import (
    DisengageSequence,
    DisengageSettings,
    EngageSequence,
    EngageSettings,
)
from mavbridge.guard.values import EndRequest, OperatorCommand, Outcome, Phase

REST_NS = 1_800 * NS_PER_MS
"""Least rest of the engage switch, low, before going high is an act: receivers that dropped out for
0.6 to 1.5 s, with a preset that puts the switch low, have looked like a hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EngagementSettings:
    """The acts that may engage, and the ways in and out."""

    engage: EngageSettings
    disengage: DisengageSettings
    arm: bool = False
    """Arm once and engage once, as soon as everything is ready."""
    engage_channel: int | None = None
    """Receiver channel, from 1, that engages when it goes high after a rest low."""
    engage_on_arm: bool = False
    """Engage when the vehicle is armed for the first time."""
    readonly: bool = False
    """Fly without sending anything."""
    duration_ns: int | None = None
    """Flight time from the first engagement on; None = until told otherwise."""


@dataclass(slots=True, kw_only=True)
class Memory:
    """Everything that the states remember."""

    settings: EngagementSettings
    first_chunk_ns: int
    """Time for the policy's first chunk after its reset."""
    engage: EngageSequence
    disengage: DisengageSequence
    phase: Phase = Phase.WAITING
    reason: Reason | None = field(default_factory=lambda: because(Code.NOT_ENGAGED))
    """Why the policy does not fly; None while it does."""
    refusal: Reason | None = None
    """Why the last act had no effect, or what the vehicle has not confirmed; its reader resets it.
    """
    failure: Reason | None = None
    """Why there was no flight: the vehicle did not take the mode or arm in time."""
    outcome: Outcome = field(default_factory=Outcome)
    act: OperatorCommand | None = None
    """Act of this step, whoever's, until a row follows it."""
    end_request: EndRequest | None = None
    """The first one: after this flight the guard ends."""
    must_stop: bool = False
    """It has not been acted upon."""
    wants_arm: bool
    """``--arm`` has not been followed yet."""
    engaged_ns: int | None = None
    """First moment of flight."""
    own_mode: str | None = None
    """The mode that we fly in, or asked for and got; any change of it is a takeover."""
    seen_interruptions: int = 0
    was_armed: bool = False
    """The vehicle was armed at the last step of preparing."""
    starting_ns: int | None = None
    """When all was ready but the policy, which is reset then; None before and after."""
    allowed_ns: int = 0
    """Time to get ready."""
    until_ns: int = 0
    """End of it."""
    released_ns: int = 0
    owes_release: bool = False
    """No release was sent yet: one is, also where nothing seems to be held."""
    stepped_ns: int | None = None
    unheard_ns: int | None = None
    """The vehicle's last word before a silence or a standstill; None: its mode is known."""
    news_from_ns: int = 0
    """What has arrived before tells of the time before the silence."""
    heard_ns: int = 0
    """The mode was last known; when we began to leave, at the earliest."""
    is_arming_awaited: bool | None = None
    """The vehicle has not been armed yet; None before it was found."""
    switch: Switch = field(default_factory=lambda: Switch(rest_ns=REST_NS))
