"""Parameters that are set for one flight and put back after it."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from enum import Enum, auto
from pathlib import Path

from mavbridge.core.errors import UserError
from mavbridge.mavlink.codec.messages import ParamRequest, ParamValue, ParamWrite
from mavbridge.mavlink.session.params.memory import Changed, ParamMemory
from mavbridge.mavlink.session.params.writer import Outcome, ParamWriter, is_same


class _Phase(Enum):
    OPENING = auto()
    """It is not known yet which vehicle this is."""
    READING = auto()
    """Its present values are on their way."""
    WAITING = auto()
    """There is something to set; the vehicle is armed, or its state is not known."""
    WRITING = auto()
    READY = auto()
    RESTORING = auto()
    ENDED = auto()


class TemporaryParams:
    """Sets the wanted parameters of a disarmed vehicle, and puts the old values back.

    The old values are on disk before anything is set, so that a later start can put back what a
    crash has left behind. The session steps it; the file is touched before and after a flight only.
    """

    def __init__(
        self,
        wanted: tuple[tuple[str, float], ...],
        *,
        restores_leftovers: bool,
        folder: Path | None,
        report: Callable[[str], None],
    ) -> None:
        self._wanted = dict(wanted)
        self._restores_leftovers = restores_leftovers
        self._folder = folder
        self._report = report
        self._phase = _Phase.READY if folder is None else _Phase.OPENING
        self._memory: ParamMemory | None = None
        self._changed: dict[str, Changed] = {}
        """Contents of the file."""
        self._elsewhere: list[tuple[ParamMemory, dict[str, Changed]]] = []
        """Files of this system id that may be of this vehicle: its unique id can get lost."""
        self._leftovers: tuple[str, ...] = ()
        self._failures: dict[str, str] = {}
        """Why a wanted parameter is not set, by name."""
        self._file_problem: str | None = None
        self._is_disarmed = False
        self._writer = ParamWriter()
        self._is_ending = False

    # --- the beginning of a session

    @property
    def is_opening(self) -> bool:
        """``open`` is still to be called."""
        return self._phase is _Phase.OPENING

    def open(self, vehicle: str) -> tuple[str, ...]:
        """Read what was left over for this vehicle; returns the names of all values to read."""
        assert self._folder is not None
        self._memory = ParamMemory(self._folder / f"{vehicle}.json")
        self._phase = _Phase.READING
        try:
            self._changed = self._memory.load()
        except UserError as error:
            self._phase = _Phase.READY
            if self._wanted or self._restores_leftovers:
                self._file_problem = str(error)
            else:
                self._report(str(error))
        kind, system, *unique_id = vehicle.split("-")
        others = f"{kind}-{system}.json" if unique_id else f"{vehicle}-*.json"
        for memory in map(ParamMemory, sorted(self._folder.glob(others))):
            try:
                self._elsewhere.append((memory, memory.load()))
            except UserError as error:
                self._report(str(error))
        names = [name for _, changed in self._elsewhere for name in changed]
        return (*self._wanted, *self._changed, *names)

    def problem(self) -> str | None:
        """Why a flight may not begin yet, or None."""
        if self._file_problem is not None or self._failures:
            return self._file_problem or "; ".join(self._failures.values())
        if self._phase in (_Phase.READY, _Phase.RESTORING, _Phase.ENDED):
            return None
        if not (self._wanted or self._restores_leftovers):
            return None
        if not self._is_disarmed and self._phase in (_Phase.WAITING, _Phase.WRITING):
            return "--set and --restore-params wait until the vehicle is disarmed"
        return "setting the vehicle's parameters"

    @property
    def is_settled(self) -> bool:
        """Nothing is being set any more."""
        return self._phase in (_Phase.READY, _Phase.ENDED)

    def receive(self, param: ParamValue) -> None:
        """Take a PARAM_VALUE: a confirmation, or a value that the pilot has mended meanwhile."""
        self._writer.receive(param)
        if param.name in self._failures and is_same(param.value, self._wanted[param.name]):
            del self._failures[param.name]

    def step(
        self, now_ns: int, values: Mapping[str, float], *, is_complete: bool, is_disarmed: bool
    ) -> Iterator[ParamWrite | ParamRequest]:
        """Requests that are due.

        ``values`` are all that the vehicle has sent; ``is_complete``: no more is on its way.
        """
        self._is_disarmed = is_disarmed
        if self._is_ending and self._phase not in (_Phase.RESTORING, _Phase.ENDED):
            self._begin_restoring(values)
        if self._phase is _Phase.READING and is_complete:
            self._sort_out_leftovers(values)
            self._phase = _Phase.WAITING
        if self._phase is _Phase.WAITING and self._has_nothing_to_do():
            self._phase = _Phase.READY
        if self._phase is _Phase.WAITING and is_disarmed:
            self._begin_writing(values)
        if self._phase in (_Phase.WRITING, _Phase.RESTORING) and is_disarmed:
            yield from self._writer.step(now_ns)
        if self._phase in (_Phase.WRITING, _Phase.RESTORING):
            self._conclude()

    def _has_nothing_to_do(self) -> bool:
        return not (self._wanted or (self._restores_leftovers and self._leftovers))

    def _sort_out_leftovers(self, values: Mapping[str, float]) -> None:
        """Tell what an earlier flight has left changed, and forget what is in order again."""
        self._adopt(values)
        in_order = [
            name
            for name, change in self._changed.items()
            if name in values and not change.is_ours(values[name])
        ]
        for name in in_order:  # put back, or set otherwise, by somebody else
            del self._changed[name]
        if in_order:
            self._save()
        leftovers = tuple(name for name in self._changed if name not in self._wanted)
        self._leftovers = leftovers
        if self._restores_leftovers:
            if not leftovers:
                self._report("--restore-params: nothing is left over from an earlier flight")
        elif leftovers:
            texts = (
                f"{name} was {self._changed[name].before:g} and is now "
                f"{self._changed[name].ours[-1]:g}"
                for name in leftovers
            )
            self._report(
                "left over from an earlier flight that did not end in order: "
                f"{', '.join(texts)}; --restore-params puts it back"
            )

    def _adopt(self, values: Mapping[str, float]) -> None:
        """Take over what stands in a file without the unique id, or under one that is lost now.

        Only what the vehicle really shows; the rest may be another vehicle's, and stays there.
        """
        for memory, changed in self._elsewhere:
            ours = {
                name: change
                for name, change in changed.items()
                if name in values and change.is_ours(values[name])
            }
            if not ours:
                continue
            self._changed = ours | self._changed
            self._save()
            with suppress(UserError):  # it is then found there once more
                memory.save({name: changed[name] for name in changed if name not in ours})

    # --- setting

    def _begin_writing(self, values: Mapping[str, float]) -> None:
        """Write the old values to disk, then start to set the new ones."""
        self._phase = _Phase.WRITING
        to_restore = self._leftovers if self._restores_leftovers else ()
        writes = {name: self._changed[name].before for name in to_restore}
        changed = dict(self._changed)
        for name, value in self._wanted.items():
            now, before = values.get(name), self._changed.get(name)
            if now is None:
                self._failures[name] = (
                    f"--set {name}={value:g}: the vehicle has sent no such parameter; check its "
                    "name, then start again"
                )
            elif not is_same(now, value):
                writes[name] = value
                is_known = before is not None and before.is_ours(now)
                changed[name] = (before if before and is_known else Changed(now, ())).then(value)
            elif before is not None:
                self._report(
                    f"{name} is {value:g} already, from an earlier flight that did not end in "
                    f"order; {before.before:g} is put back at the end of this one"
                )
        assert self._memory is not None
        try:
            self._memory.save(changed)
        except UserError as error:
            self._file_problem = f"{error}; nothing is set without that"
            return
        self._changed = changed
        for name, value in writes.items():
            self._writer.write(name, value)

    def _save(self) -> None:
        """Remember what is in order again."""
        assert self._memory is not None
        try:
            self._memory.save(self._changed)
        except UserError as error:
            self._report(str(error))

    def _conclude(self) -> None:
        """Take in what the writer has ended; go on once it is done."""
        outcomes = self._writer.take_outcomes()
        for outcome in outcomes:
            if outcome.name in self._wanted and self._phase is _Phase.WRITING:
                self._conclude_set(outcome)
            else:
                self._conclude_restore(outcome)
        if self._phase is _Phase.RESTORING and not self._is_disarmed and not self._writer.is_done:
            self._writer.cancel()
            self._report_what_stays()
        if outcomes:
            self._save()
        if self._writer.is_done:
            self._phase = _Phase.READY if self._phase is _Phase.WRITING else _Phase.ENDED

    def _conclude_set(self, outcome: Outcome) -> None:
        name, change = outcome.name, self._changed[outcome.name]
        if outcome.is_confirmed:
            self._report(f"{name} set from {change.before:g} to {outcome.asked:g} for this flight")
            return
        answer = "it does not answer"
        if outcome.answer is not None:
            answer = f"it stays at {outcome.answer:g}"
            if is_same(outcome.answer, change.before):
                del self._changed[name]
        self._failures[name] = (
            f"the vehicle did not take --set {name}={outcome.asked:g}: {answer}; set it with your "
            "ground station, or leave the flag out"
        )

    # --- putting back

    def begin_restore(self) -> None:
        """Put everything back that this session has set; ``is_restored`` tells when it is done."""
        self._is_ending = True

    @property
    def is_restored(self) -> bool:
        """Nothing of this session is left to put back, or no more can be done about it now."""
        asks_nothing = not (self._wanted or self._restores_leftovers)
        is_untouched = asks_nothing or (not self._wanted and self._phase is _Phase.READY)
        return self._is_ending and (self._phase is _Phase.ENDED or is_untouched)

    def _begin_restoring(self, values: Mapping[str, float]) -> None:
        self._writer.cancel()
        self._writer.take_outcomes()
        self._phase = _Phase.RESTORING
        if self._memory is None:
            return
        for name in [name for name in self._wanted if name in self._changed]:
            change, now = self._changed[name], values.get(name)
            if now is not None and not change.is_ours(now) and not is_same(now, change.before):
                self._report(f"{name} was set to {now:g} by another station: it is left so")
                del self._changed[name]
                self._save()
            elif self._is_disarmed:
                # Also if it seems to have its old value: a write may be on its way.
                self._writer.write(name, change.before)
        if not self._is_disarmed:
            self._report_what_stays()

    def _report_what_stays(self) -> None:
        names = [name for name in self._wanted if name in self._changed]
        if names:
            texts = (f"{name} (it was {self._changed[name].before:g})" for name in names)
            self._report(
                "the vehicle is still armed, so what was set for the flight stays: "
                f"{', '.join(texts)}; start with --restore-params to put it back"
            )

    def _conclude_restore(self, outcome: Outcome) -> None:
        if outcome.is_confirmed:
            self._report(f"{outcome.name} put back to {outcome.asked:g}")
            del self._changed[outcome.name]
        else:
            self._report(
                f"{outcome.name} could not be put back to {outcome.asked:g}: the vehicle did not "
                "confirm it; start with --restore-params to try again"
            )
