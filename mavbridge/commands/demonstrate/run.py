"""``mavbridge demonstrate`` from its config to its exit status: many flights, resumable."""

from rich.console import Console
from rich.text import Text

from mavbridge.commands.demonstrate.config import DemonstrateConfig
from mavbridge.commands.demonstrate.flight import DemonstrationSpec, fly_demonstration
from mavbridge.commands.episode_workers import fly_jobs
from mavbridge.commands.output import progress_bar
from mavbridge.core.errors import UserError
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals
from mavbridge.recording.folder import META
from mavbridge.recording.meta import FlightError, read_meta


def demonstrate(config: DemonstrateConfig) -> int:
    """Fly every episode that is not recorded yet; 130 if interrupted, to be resumed later.

    Raises:
        MavbridgeError: a flight cannot be flown or recorded.
    """
    console = Console(stderr=True, emoji=False)
    specs = _missing(config)
    done = config.episodes - len(specs)
    if done:
        console.print(Text(f"{done} of {config.episodes} are there already", style="dim"))
    successes = 0
    with stop_on_signals() as stop, progress_bar(console) as progress:
        bar = progress.add_task("demonstrating", total=config.episodes, completed=done)
        flown = fly_jobs(fly_demonstration, specs, config.workers, stop.is_set)
        for count, (_, success) in enumerate(flown, start=1):
            successes += success
            progress.update(bar, advance=1, status=f"{successes} of {count} finished the course")
        was_stopped = stop.is_set()
    if was_stopped:
        console.print(Text("interrupted: run the same command to resume", style="yellow"))
        return INTERRUPTED
    return 0


def _missing(config: DemonstrateConfig) -> list[DemonstrationSpec]:
    """The episodes without a finished recording.

    Raises:
        UserError: the folder of an episode holds something that is no flight.
    """
    specs = []
    for index in range(config.episodes):
        folder = config.out / f"{index:06d}"
        if folder.is_dir() and any(folder.iterdir()):
            if not (folder / META).is_file():
                raise UserError(f"{folder} is no recorded flight: name another --out")
            try:
                if read_meta(folder).finished:
                    continue
            except FlightError:
                pass  # cut off while it was written
        seed = config.first_course_seed + index
        specs.append(DemonstrationSpec(folder=folder, seed=seed, config=config))
    return specs
