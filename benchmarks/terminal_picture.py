"""Draw the output of a command as SVG.

python -m benchmarks.terminal_picture docs/images/check.svg mavbridge check --connect none
"""

import os
import subprocess
import sys
from pathlib import Path

from rich.console import Console
from rich.text import Text

COLUMNS = 110


def main() -> None:
    """Run the command and write the picture of its standard output."""
    out, *command = sys.argv[1:]
    colours = os.environ | {"FORCE_COLOR": "1", "COLUMNS": str(COLUMNS)}
    run = subprocess.run(command, env=colours, capture_output=True, text=True, check=False)
    with Path(os.devnull).open("w") as nowhere:
        console = Console(record=True, width=COLUMNS, file=nowhere)
        console.print(Text.from_ansi(run.stdout))
        console.save_svg(out, title=" ".join(command))


if __name__ == "__main__":
    main()
