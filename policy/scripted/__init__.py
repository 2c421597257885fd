"""Bring-up policies that fly a fixed program by feedback on velocity: no weights, no torch.

They speak the whole dual-rate protocol and put out any kind of action, so both loops, the link and
the vehicle can be tried before anything is trained.
"""

from policy.scripted.controllers import PROGRAM_NAMES
from policy.scripted.policy import ScriptedPolicy

__all__ = ["PROGRAM_NAMES", "ScriptedPolicy"]
