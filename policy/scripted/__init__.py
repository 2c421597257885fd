"""Bring-up policies that fly a fixed program by velocity feedback: no weights, no torch.

They implement the whole dual-rate protocol and any action kind, so both loops, the link and the
vehicle can be tried before anything is trained.
"""

from policy.scripted.controllers import PROGRAM_NAMES
from policy.scripted.policy import ScriptedPolicy

__all__ = ["PROGRAM_NAMES", "ScriptedPolicy"]
