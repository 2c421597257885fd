"""Draw the viewer's page Timing and the page of inspect as PNG.

python -m benchmarks.page_pictures out/flight.rrd flights/race out/gates.json docs/images

Needs Chromium, and a screen or ``xvfb-run`` with a Vulkan driver (mesa-vulkan-drivers).
"""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import rerun.blueprint as rrb

from mavbridge.commands.inspect.analysis import FlightAnalysis
from mavbridge.commands.inspect.page import write_page
from mavbridge.observe.viewer_layout import timing_page

SIZE_PX, PAGE_PX = (1500, 900), "1000,1500"
TIMEOUT_S = 120.0


def main() -> None:
    """Draw timing.png and inspect.png into a folder."""
    rrd, flight, gates, out = map(Path, sys.argv[1:])
    with TemporaryDirectory(prefix="mavbridge-pages-") as name:
        layout, page = Path(name) / "timing.rbl", Path(name) / "page.html"
        panel = rrb.TimePanel(state="collapsed", timeline="time")
        rrb.Blueprint(timing_page(), panel, collapse_panels=True).save("mavbridge", str(layout))
        size, shot = "{}x{}".format(*SIZE_PX), Path(name) / "timing.png"
        _run("rerun", rrd, layout, "--window-size", size, "--screenshot-to", shot)
        image = cv2.imread(str(shot))
        assert image is not None  # rerun has written it
        small = cv2.resize(image, SIZE_PX, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(out / "timing.png"), small, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        write_page(page, [FlightAnalysis(flight, gates=gates)])
        flags = ("--headless", "--no-sandbox", "--hide-scrollbars", f"--window-size={PAGE_PX}")
        wait = "--virtual-time-budget=8000"
        _run("chromium", *flags, wait, f"--screenshot={out / 'inspect.png'}", page.as_uri())


def _run(*command: object) -> None:
    subprocess.run([*map(str, command)], check=True, timeout=TIMEOUT_S)


if __name__ == "__main__":
    main()
