"""Train a policy that ships.

python -m benchmarks.train_shipped toge --out training

Both start from the weights shipped before, taken from this repository's history. toge: in three
rounds they fly, the expert corrects them, and they learn from that. toge-rates learns the end of a
flight alone, in two rounds. Then both learn other looks (teach_looks.py). What shipped was made a
little differently (policy/weights/README.md), and neither recipe has been run as a whole.

Run the same command again to resume after an interruption: recorded flights and written weights are
kept, and an unfinished training begins again. Seeds determine the flights. Training budgets are
minutes, so another machine makes similar weights, not the same.
"""

import subprocess
import sys
from pathlib import Path
from typing import Literal, NamedTuple

from cyclopts import App

from benchmarks import teach_looks
from mavbridge.commands.output import table_console

app = App(help=__doc__)

HERE = Path(__file__).parent

SIZE = "--set-config network.image_size=96"
"""Side of the recorded images."""
NET = "--policy toge:small:resnet8 --image-size 96 --batch-size 64"
RACES, LOOPS, PX4 = "--action rates --courses race", "--courses loop", "--autopilot px4"
STICKS, END = "--include-failed --ages 10:220", "--include-failed --ages 10:140 --only-end"

LOOK_MINUTES = {"toge": 68, "toge-rates": 250}
BEFORE = "438fb84af6f14453cf773d90c24cdd1e15b7b50a"
"""Commit of 2026-11-27 with the weights to start from."""


class Step(NamedTuple):
    """One command, and the file or folder that it makes in ``--out``."""

    makes: str
    command: str


def flights(makes: str, flags: str, student: str | None = None) -> Step:
    """Return a step that records flights of the expert, or of a student that it corrects."""
    own = "" if student is None else f" --checkpoint {student}.safetensors"
    return Step(makes, f"demonstrate {flags}{own}")


def training(makes: str, data: str, flags: str, start: str | None = None) -> Step:
    """Return a step that trains on these folders, from the weights of an earlier training."""
    start_from = "" if start is None else f" --start-from {start}.safetensors"
    return Step(f"{makes}.safetensors", f"train {data} {NET} {flags}{start_from}")


STEPS: dict[str, tuple[Step, ...]] = {
    "toge": (
        flights("easy1", "--episodes 44 --seed 80 --speed 6.7", "before"),
        flights("loop1", f"--episodes 26 --seed 82 --speed 6.5 {LOOPS}", "before"),
        flights("px1", f"--episodes 22 --seed 81 --speed 6.5 {PX4}", "before"),
        training("first", "easy1 loop1 px1", f"--minutes 14 {STICKS}", start="before"),
        flights("easy2", "--episodes 36 --seed 83 --speed 6.7", "first"),
        flights("loop2", f"--episodes 16 --seed 84 --speed 6.5 {LOOPS}", "first"),
        flights("px2", f"--episodes 16 --seed 85 --speed 6.5 {PX4}", "first"),
        training(
            "second",
            "easy1 loop1 px1 easy2 loop2 px2",
            f"--minutes 26 {STICKS}",
            start="first",
        ),
        flights("easy3", "--episodes 44 --seed 52 --speed 6.7", "second"),
        flights("loop3", f"--episodes 12 --seed 54 --speed 6.5 {LOOPS}", "second"),
        flights("px3", f"--episodes 16 --seed 53 --speed 6.5 {PX4}", "second"),
        training(
            "third",
            "easy1 loop1 px1 easy2 loop2 px2 easy3 loop3 px3",
            f"--minutes 40 {STICKS}",
            start="second",
        ),
    ),
    "toge-rates": (
        flights("races", f"--episodes 32 --seed 10 --speed 9.5 {RACES}"),
        flights("loops", f"--episodes 10 --seed 15 --speed 9 --action rates {LOOPS}"),
        flights("px", f"--episodes 8 --seed 14 --speed 9 {RACES} {PX4}"),
        flights("own_races", f"--episodes 20 --seed 76 --speed 9.5 {RACES}", "before"),
        flights("own_loops", f"--episodes 8 --seed 74 --speed 9 --action rates {LOOPS}", "before"),
        flights("own_px", f"--episodes 8 --seed 75 --speed 9 {RACES} {PX4}", "before"),
        training(
            "first",
            "races loops px own_races own_loops own_px",
            f"--minutes 10 {END}",
            start="before",
        ),
        flights("stopping", f"--episodes 16 --seed 78 --speed 9.5 --max-time 60 {RACES}", "first"),
        flights(
            "stopping_px", f"--episodes 10 --seed 79 --speed 9 --max-time 60 {RACES} {PX4}", "first"
        ),
        training(
            "stops",
            "races loops px own_races own_loops own_px stopping stopping_px",
            f"--minutes 9 {END}",
            start="before",
        ),
    ),
}


@app.default
def main(policy: Literal["toge", "toge-rates"], *, out: Path, workers: int = 2) -> None:
    """Run all steps that are not done yet.

    Args:
        policy: the policy to train.
        out: folder for flights and weights; one per policy is made in it.
        workers: flights at a time.
    """
    folder = out / policy
    folder.mkdir(parents=True, exist_ok=True)
    copy_weights_before(policy, folder / "before.safetensors")
    for step in STEPS[policy]:
        if step.command.startswith("demonstrate"):
            run(folder, f"{step.command} {SIZE} --workers {workers} --out {step.makes}")
        elif not (folder / step.makes).exists():
            run(folder, f"{step.command} --out partial.safetensors")
            (folder / "partial.safetensors").replace(folder / step.makes)
    if not (taught := folder / f"{policy}.safetensors").exists():
        before = folder / STEPS[policy][-1].makes
        teach_looks.main(before, out=taught, minutes=LOOK_MINUTES[policy])


def copy_weights_before(policy: str, path: Path) -> None:
    """Write the weights that shipped before; exit with a message if git lacks them."""
    if path.exists():
        return
    name = f"{BEFORE}:policy/weights/{policy}.safetensors"
    partial = path.with_suffix(".part")
    try:
        with partial.open("wb") as file:
            subprocess.run(["git", "show", name], cwd=HERE, stdout=file, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        partial.unlink(missing_ok=True)
        raise SystemExit(f"{error}: a shallow clone needs git fetch --unshallow") from error
    partial.replace(path)


def run(folder: Path, command: str) -> None:
    """Run one mavbridge command in the folder; exit with its status if it fails."""
    table_console().print(f"mavbridge {command}", soft_wrap=True)
    done = subprocess.run([sys.executable, "-m", "mavbridge", *command.split()], cwd=folder)
    if done.returncode:
        raise SystemExit(done.returncode)


if __name__ == "__main__":
    app()
