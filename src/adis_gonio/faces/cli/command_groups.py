"""The help of the program and of its commands: commands in groups, options in sections."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import click

from adis_gonio.base.errors import suggest


class Home(NamedTuple):
    """Module of a command (it defines `NAME_command`), and the one-line help of the command."""

    module: str
    help: str


class LazyGroup(click.Group):
    """Group that imports the module of a command only when the command is called.

    Parameters
    ----------
    groups : mapping
        For each heading of the help the `Home` of each command, by the command's name.
    """

    def __init__(self, *args: Any, groups: Mapping[str, Mapping[str, Home]], **more: Any) -> None:
        super().__init__(*args, **more)
        self._groups = groups
        self._homes = {name: home for group in groups.values() for name, home in group.items()}

    def list_commands(self, ctx: click.Context) -> list[str]:
        """List the names of the commands in the order of their definition."""
        return list(self._homes)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import the module of the command `cmd_name` and return the command; None if there is none."""
        if cmd_name not in self._homes:
            return None
        module = importlib.import_module(f"{__package__}.{self._homes[cmd_name].module}")
        command: click.Command = getattr(module, f"{cmd_name}_command")
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find a command by its name, the first of `args`.

        The error for an unknown name suggests the most similar command.
        """
        if args and args[0] not in self._homes and not args[0].startswith("-"):
            hint = suggest(args[0], self._homes, "see adis-gonio --help")
            raise click.UsageError(f"no command is called '{args[0]}'; {hint}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the help of the group: each heading with its commands, without importing them."""
        width = max(map(len, self._homes))
        for heading, group in self._groups.items():
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(width), home.help) for name, home in group.items()])


class SectionedCommand(click.Command):
    """Command that lists its options in sections of the help.

    Parameters
    ----------
    sections : mapping of str to str
        For each heading of the help the flags of its section, separated by spaces. An option in two
        sections is listed in the first. The options in no section come last.
    """

    def __init__(self, *args: Any, sections: Mapping[str, str], **more: Any) -> None:
        super().__init__(*args, **more)
        self.sections = sections

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options of a command into its help, in sections."""
        options = [param for param in self.get_params(ctx) if isinstance(param, click.Option)]
        rows = {option.opts[0]: option.get_help_record(ctx) for option in options}
        records = {flag: record for flag, record in rows.items() if record is not None}
        for heading, flags in self.sections.items():
            lines = [records.pop(flag) for flag in flags.split() if flag in records]
            if lines:
                with formatter.section(heading):
                    formatter.write_dl(lines)
        with formatter.section("Other options" if len(records) < len(rows) else "Options"):
            formatter.write_dl(list(records.values()))
