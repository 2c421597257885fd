"""Train a policy that ships, from nothing.

python -m benchmarks.train_shipped toge --out training

Flights of the expert teach a first student; in rounds the students fly, the expert corrects them,
and they learn from that. toge-rates then learns the end of a flight alone, in two rounds. At last
both learn other looks (teach_looks.py). The trainings take 3 h 5 min for toge and 6 h 32 min for
toge-rates, beside the flights. What shipped was made a little differently
(policy/weights/README.md). Neither recipe has been run in full; both have been run to the end with
two flights a step and eight optimiser steps a training.

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

SIZE = "--set-config network.image_size=96"
"""Side of the recorded images."""
NET = "--policy toge:small:resnet8 --image-size 96 --batch-size 64"
RACES, LOOPS, PX4 = "--action rates --courses race", "--courses loop", "--autopilot px4"
STICKS, RATES = "--include-failed --ages 10:220", "--ages 10:140"
END = "--include-failed --ages 10:140 --only-end"

LOOK_MINUTES = {"toge": 68, "toge-rates": 250}
ONE, TWO, THREE = (f"easy{n} loop{n} px{n}" for n in (1, 2, 3))
FAST, FAST_1, FAST_2, FAST_3 = "fast fast_px", "fast1 fast1_px", "fast2 fast2_px", "fast3 fast3_px"
ENDS = "races loops px own_races own_loops own_px"
"""Folders of flights that one round makes."""


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
        flights("expert", "--episodes 110 --seed 6 --speed 7"),
        training("zeroth", "expert", f"--minutes 20 {STICKS}"),
        flights("own", "--episodes 26 --seed 7 --speed 7", "zeroth"),
        training("before", "expert own", f"--minutes 17 {STICKS}", "zeroth"),
        flights("easy1", "--episodes 44 --seed 80 --speed 6.7", "before"),
        flights("loop1", f"--episodes 26 --seed 82 --speed 6.5 {LOOPS}", "before"),
        flights("px1", f"--episodes 22 --seed 81 --speed 6.5 {PX4}", "before"),
        training("first", ONE, f"--minutes 14 {STICKS}", "before"),
        flights("easy2", "--episodes 36 --seed 83 --speed 6.7", "first"),
        flights("loop2", f"--episodes 16 --seed 84 --speed 6.5 {LOOPS}", "first"),
        flights("px2", f"--episodes 16 --seed 85 --speed 6.5 {PX4}", "first"),
        training("second", f"{ONE} {TWO}", f"--minutes 26 {STICKS}", "first"),
        flights("easy3", "--episodes 44 --seed 52 --speed 6.7", "second"),
        flights("loop3", f"--episodes 12 --seed 54 --speed 6.5 {LOOPS}", "second"),
        flights("px3", f"--episodes 16 --seed 53 --speed 6.5 {PX4}", "second"),
        training("third", f"{ONE} {TWO} {THREE}", f"--minutes 40 {STICKS}", "second"),
    ),
    "toge-rates": (
        flights("fast", f"--episodes 100 --seed 3 --speed 9.5 {RACES}"),
        flights("fast_px", f"--episodes 30 --seed 4 --speed 9 {RACES} {PX4}"),
        training("zeroth", FAST, f"--minutes 45 {RATES}"),
        flights("fast1", f"--episodes 54 --seed 11 --speed 9 {RACES}", "zeroth"),
        flights("fast1_px", f"--episodes 14 --seed 12 --speed 9 {RACES} {PX4}", "zeroth"),
        training("first", f"{FAST} {FAST_1}", f"--minutes 22 {RATES}", "zeroth"),
        flights("fast2", f"--episodes 44 --seed 13 --speed 9 {RACES}", "first"),
        flights("fast2_px", f"--episodes 20 --seed 14 --speed 9 {RACES} {PX4}", "first"),
        training("second", f"{FAST} {FAST_1} {FAST_2}", f"--minutes 22 {RATES}", "first"),
        flights("fast3", f"--episodes 50 --seed 34 --speed 9 {RACES}", "second"),
        flights("fast3_px", f"--episodes 24 --seed 35 --speed 9 {RACES} {PX4}", "second"),
        training("before", f"{FAST} {FAST_1} {FAST_2} {FAST_3}", f"--minutes 34 {RATES}", "second"),
        flights("races", f"--episodes 32 --seed 10 --speed 9.5 {RACES}"),
        flights("loops", f"--episodes 10 --seed 15 --speed 9 --action rates {LOOPS}"),
        flights("px", f"--episodes 8 --seed 14 --speed 9 {RACES} {PX4}"),
        flights("own_races", f"--episodes 20 --seed 76 --speed 9.5 {RACES}", "before"),
        flights("own_loops", f"--episodes 8 --seed 74 --speed 9 --action rates {LOOPS}", "before"),
        flights("own_px", f"--episodes 8 --seed 75 --speed 9 {RACES} {PX4}", "before"),
        training("third", ENDS, f"--minutes 10 {END}", "before"),
        flights("stopping", f"--episodes 16 --seed 78 --speed 9.5 --max-time 60 {RACES}", "third"),
        flights(
            "stopping_px", f"--episodes 10 --seed 79 --speed 9 --max-time 60 {RACES} {PX4}", "third"
        ),
        training("stops", f"{ENDS} stopping stopping_px", f"--minutes 9 {END}", "before"),
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
    for step in STEPS[policy]:
        if step.command.startswith("demonstrate"):
            run(folder, f"{step.command} {SIZE} --workers {workers} --out {step.makes}")
        elif not (folder / step.makes).exists():
            run(folder, f"{step.command} --out partial.safetensors")
            (folder / "partial.safetensors").replace(folder / step.makes)
    if not (taught := folder / f"{policy}.safetensors").exists():
        before = folder / STEPS[policy][-1].makes
        teach_looks.main(before, out=taught, minutes=LOOK_MINUTES[policy])


def run(folder: Path, command: str) -> None:
    """Run one mavbridge command in the folder; exit with its status if it fails."""
    table_console().print(f"mavbridge {command}", soft_wrap=True)
    done = subprocess.run([sys.executable, "-m", "mavbridge", *command.split()], cwd=folder)
    if done.returncode:
        raise SystemExit(done.returncode)


if __name__ == "__main__":
    app()
