"""Mutation testing of what must never be wrong: ``make mutants``.

Collects the tests of a group once, notes which lines each one runs, and forks for every mutant: the
child exchanges the code of one function, or one constant, and runs the tests that reach the changed
lines, the fastest first, until one fails. ``reasons.toml`` has the groups, and the reason of
each mutant that may survive; one without a reason ends this with status 1.
"""

import argparse
import ast
import gc
import os
import pickle
import resource
import signal
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time
from types import CodeType, FrameType, FunctionType
from typing import Any

import pytest
from hypothesis import Phase, settings

from mutation.operators import Mutant, mutants_of

ROOT = Path(__file__).parents[2]
REASONS = Path(__file__).with_name("reasons.toml")
_PYTEST = (
    *("-q", "-s", "-p", "no:cacheprovider", "-p", "no:xdist"),
    *("--hypothesis-seed=0", "--hypothesis-profile=mutants"),
    *("-W", "ignore::pytest.PytestAssertRewriteWarning"),
)


@dataclass
class Reach:
    """Lines of the mutated files that each test of a group runs, and its CPU time."""

    lines: list[dict[str, set[int]]] = field(default_factory=list)
    cost_s: list[float] = field(default_factory=list)


@dataclass
class Verdicts:
    """Names of one module's mutants."""

    killed: list[str] = field(default_factory=list)
    survived: list[str] = field(default_factory=list)


class Driver:
    """Plugin that replaces pytest's loop over the tests."""

    def __init__(self, modules: list[str], jobs: int, only: tuple[str, ...]) -> None:
        self._jobs = jobs
        self._only = only
        self._files = {str(ROOT / module): module for module in modules}
        self.verdicts = {module: Verdicts() for module in modules}
        self.is_sound = False
        """Every test passed without a mutant."""

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Measure the tests, then try every mutant."""
        # Children would each make a numbered folder otherwise.
        session.config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]
        reach = self._reach(session)
        self.is_sound = reach is not None
        if reach is None:
            return True
        functions = self._functions()
        gc.freeze()
        running: dict[int, tuple[str, str]] = {}
        for path, module in self._files.items():
            for mutant in mutants_of(Path(path).read_text()):
                if not mutant.name.startswith(self._only):
                    continue
                # A constant is read anywhere, and a default by code that has no line: all tests.
                is_constant = mutant.scope not in functions[path]
                tests = [
                    k
                    for k, reached in enumerate(reach.lines)
                    if is_constant or any(n in mutant.lines for n in reached[path])
                ]
                tests.sort(key=lambda k: reach.cost_s[k])
                while len(running) >= self._jobs:
                    self._reap(running)
                pid = os.fork()
                if pid == 0:
                    _try(session, mutant, path, functions[path], tests, reach.cost_s)
                running[pid] = (module, mutant.name)
        while running:
            self._reap(running)
        return True

    def _reap(self, running: dict[int, tuple[str, str]]) -> None:
        pid, status = os.wait()
        module, name = running.pop(pid)
        verdicts = self.verdicts[module]
        (verdicts.survived if status == 0 else verdicts.killed).append(name)
        if status == 0:
            sys.stderr.write(f"survives: {module} {name}\n")

    def _reach(self, session: pytest.Session) -> Reach | None:
        """Run every test once, traced, in a child, which leaves no trace in this process."""
        reading, writing = os.pipe()
        if (pid := os.fork()) == 0:
            reach = Reach()
            for k, item in enumerate(session.items):
                lines: dict[str, set[int]] = {path: set() for path in self._files}
                began_s = process_time()
                sys.settrace(_tracer(lines))
                _run(session, k)
                sys.settrace(None)
                reach.cost_s.append(process_time() - began_s)
                reach.lines.append(lines)
                if session.testsfailed:
                    sys.stderr.write(f"fails without a mutant: {item.nodeid}\n")
                    os._exit(1)
            with os.fdopen(writing, "wb") as pipe:
                pickle.dump(reach, pipe)
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading, "rb") as pipe:
            data = pipe.read()
        os.waitpid(pid, 0)
        return pickle.loads(data) if data else None

    def _functions(self) -> dict[str, dict[str, list[FunctionType]]]:
        """The live functions of each file, by qualified name: those of slotted classes twice."""
        found: dict[str, dict[str, list[FunctionType]]] = {path: {} for path in self._files}
        gc.unfreeze()  # what the group before has frozen is not listed
        for thing in gc.get_objects():
            if isinstance(thing, FunctionType) and thing.__code__.co_filename in found:
                by_name = found[thing.__code__.co_filename]
                by_name.setdefault(thing.__code__.co_qualname, []).append(thing)
        return found


def _tracer(lines: dict[str, set[int]]) -> Any:
    def local(frame: FrameType, _event: str, _argument: object) -> Any:
        lines[frame.f_code.co_filename].add(frame.f_lineno)
        return local

    def trace(frame: FrameType, event: str, argument: object) -> Any:
        return local(frame, event, argument) if frame.f_code.co_filename in lines else None

    return trace


def _run(session: pytest.Session, index: int, following: int | None = None) -> None:
    item = session.items[index]
    nextitem = None if following is None else session.items[following]
    item.config.hook.pytest_runtest_protocol(item=item, nextitem=nextitem)


def _try(
    session: pytest.Session,
    mutant: Mutant,
    path: str,
    functions: dict[str, list[FunctionType]],
    tests: list[int],
    cost_s: list[float],
) -> None:
    """In the child: exit with 0 if every test passes with the mutant."""
    session.config.pluginmanager.unregister(name="terminalreporter")
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        _install(mutant, path, functions)
        for k, following in zip(tests, [*tests, None][1:], strict=True):
            # A mutant that hangs: the signal ends the process.
            signal.setitimer(signal.ITIMER_PROF, 1.0 + 5 * cost_s[k])
            _run(session, k, following)
            if session.testsfailed:
                os._exit(1)
    except BaseException:  # noqa: BLE001 - a mutant may raise anything, also pytest.exit
        os._exit(1)
    os._exit(0)


def _install(mutant: Mutant, path: str, functions: dict[str, list[FunctionType]]) -> None:
    if mutant.scope in functions:
        code = compile(mutant.tree, path, "exec")
        changed = next(part for part in _parts(code) if part.co_qualname == mutant.scope)
        for function in functions[mutant.scope]:
            function.__code__ = changed
        return
    name = next(
        name
        for name, module in sys.modules.items()
        if getattr(module, "__file__", None) == path and not name.startswith("tests")
    )
    live = sys.modules[name]
    begins = [part for part in mutant.tree.body if part.lineno <= mutant.lines[0]]
    space = dict(vars(live))  # an exception of this module stays the one that others catch
    exec(compile(ast.Module(begins[-1:], []), path, "exec"), space)
    owner = mutant.scope.rpartition(".")[0]
    if owner:
        _change_default(getattr(live, owner), space[owner])
        return
    for constant, value in space.items():
        if (old := getattr(live, constant)) is not value:
            for module in list(sys.modules.values()):
                if vars(module).get(constant) is old:
                    setattr(module, constant, value)


def _change_default(owner: type, changed: type) -> None:
    """Give a dataclass or named tuple the default of its mutant."""
    for function in ("__init__", "__new__"):
        old, new = getattr(owner, function, None), getattr(changed, function, None)
        if isinstance(old, FunctionType) and isinstance(new, FunctionType):
            old.__defaults__, old.__kwdefaults__ = new.__defaults__, new.__kwdefaults__


def _parts(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _parts(constant)


def _report(verdicts: dict[str, Verdicts], reasons: dict[str, dict[str, str]]) -> bool:
    """Print a row for each module, and the survivors; returns whether each has a reason.

    A reason counts for every mutant whose name begins with its key.
    """
    is_good = True
    for module, found in verdicts.items():
        keys = list(reasons.get(module, {}))
        unknown = [n for n in sorted(found.survived) if not any(n.startswith(k) for k in keys)]
        idle = [k for k in keys if not any(n.startswith(k) for n in found.survived)]
        counts = (len(found.killed), len(found.survived) - len(unknown), len(unknown))
        sys.stdout.write(
            f"{module}: {sum(counts)} mutants, {counts[0]} killed, {counts[1]} with a reason, "
            f"{counts[2]} without\n"
        )
        sys.stdout.writelines(f"  SURVIVED {name}\n" for name in unknown)
        sys.stdout.writelines(f"  reason of none that survives: {key}\n" for key in idle)
        is_good = is_good and not unknown and not idle
    return is_good


def main() -> int:
    """Run the groups that have one of the modules; without any, all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("modules", nargs="*", help="as in reasons.toml")
    parser.add_argument("--only", action="append", help="mutants whose name begins so")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    wanted = parser.parse_args()
    document = tomllib.loads(REASONS.read_text())
    settings.register_profile(
        "mutants", deadline=None, database=None, phases=[Phase.explicit, Phase.generate]
    )
    is_good = True
    for group in document["group"]:
        modules = [m for m in group["modules"] if not wanted.modules or m in wanted.modules]
        if modules:
            driver = Driver(modules, wanted.jobs, tuple(wanted.only or [""]))
            pytest.main([*_PYTEST, *group["tests"]], plugins=[driver])
            is_good = _report(driver.verdicts, document["reasons"]) and driver.is_sound and is_good
    return 0 if is_good else 1


if __name__ == "__main__":
    sys.exit(main())
