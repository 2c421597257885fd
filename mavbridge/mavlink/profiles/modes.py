"""Flight modes of one firmware by name."""

from dataclasses import replace

from mavbridge.core.errors import UserError
from mavbridge.core.vehicle import ModeRoles


class ModeTable:
    """Names and numbers of flight modes; a main mode with sub-modes has one name for each.

    ``shift`` and ``sub_shift`` say where main mode and sub-mode stand in HEARTBEAT.custom_mode, as
    numbers of eight bits; None = all of it is the mode, and there are no sub-modes. Modes that are
    ``never_commanded`` have only a name.
    """

    def __init__(
        self,
        names: dict[int, str],
        *,
        roles: ModeRoles,
        shift: int | None = None,
        sub_shift: int = 0,
        sub_modes: dict[str, dict[int, str]] | None = None,
        never_commanded: tuple[str, ...] = (),
    ) -> None:
        self._names = names
        self._shift, self._sub_shift = shift, sub_shift
        self._sub_modes = sub_modes or {}
        self._commands: dict[str, tuple[int, int]] = {}
        for number, name in names.items():
            if name in self._sub_modes:
                subs = self._sub_modes[name].items()
                self._commands |= {f"{name}.{sub}": (number, code) for code, sub in subs}
            elif name not in never_commanded:
                self._commands[name] = (number, 0)
        self.roles = replace(roles, names=tuple(self._commands))
        """All modes that can be asked for, and what each is good for."""

    def name(self, custom_mode: int) -> str:
        """Name of HEARTBEAT.custom_mode, or its number if it has no name."""
        number = custom_mode if self._shift is None else custom_mode >> self._shift & 0xFF
        name = self._names.get(number, str(number))
        if name in self._sub_modes:
            sub = custom_mode >> self._sub_shift & 0xFF
            return f"{name}.{self._sub_modes[name].get(sub, sub)}"
        return name

    def command(self, name: str) -> tuple[int, int]:
        """Parameters 2 and 3 of MAV_CMD_DO_SET_MODE.

        Raises:
            UserError: the vehicle has no such mode.
        """
        numbers = self._commands.get(name.upper())
        if numbers is None:
            raise UserError(
                f"this vehicle has no mode {name!r}; it has {', '.join(sorted(self._commands))}"
            )
        return numbers
