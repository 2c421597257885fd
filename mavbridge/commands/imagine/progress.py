"""What a person sees of a rollout while it runs."""

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from mavbridge.commands.imagine.output import Output
from mavbridge.commands.imagine.plan import RolloutPlan


class RolloutProgress:
    """Frames, iterations, both queues, time left; used by the loop's thread."""

    def __init__(self, console: Console, plan: RolloutPlan, output: Output) -> None:
        self._plan = plan
        self._output = output
        self.iterations = 0
        """Done."""
        self._bar = Progress(
            TextColumn("imagining"),
            BarColumn(),
            TextColumn("{task.completed}/{task.total} frames"),
            TextColumn("{task.fields[news]}"),
            TimeRemainingColumn(),
            console=console,
        )
        self._task = self._bar.add_task("imagining", total=plan.iterations * plan.frames, news="")

    def __enter__(self) -> "RolloutProgress":
        """Show it."""
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the last line."""
        self.refresh()
        self._bar.stop()

    def refresh(self) -> None:
        """Take the numbers as they are now."""
        output = self._output
        self._bar.update(
            self._task,
            completed=output.frames,
            news=f"iteration {self.iterations}/{self._plan.iterations}  "
            f"decode queue {output.decode_queue}  writer queue {output.writer_queue}",
        )
