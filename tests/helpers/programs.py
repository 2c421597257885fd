"""Programs that are run to their end."""

import subprocess
from subprocess import CompletedProcess
from typing import Any


def ended(*command: str, **options: Any) -> CompletedProcess[str]:
    """The program after its end, with its output as text."""
    return subprocess.run(command, capture_output=True, text=True, timeout=300, **options)
