"""Command groups of ``eapctl``, the main one, and the single exit for every error.

Each error ends as one line on stderr (a plant file: one line for each finding) and an exit code,
never as a traceback; ``EAP_DEBUG=1`` prints the traceback above that line.  The module of a command
is imported when the command is used: the front end owns no plant, and starts within milliseconds.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from enum import IntEnum
from importlib import import_module
from types import MappingProxyType
from typing import Any, NoReturn

import click

from eap.errors import ConfigError, EapError, EnvironmentalError, describe_os_error
from eap.suggest import suggest

DEBUG_VARIABLE = "EAP_DEBUG"


_NEXT_CAUSE = "\n  "


class ExitCode(IntEnum):
    """Exit status."""

    DONE = 0
    FAILED = 1
    """Refused or failed."""
    UNUSABLE = 2
    """Usage, configuration or environment."""


class CommandGroup(click.Group):
    """Group that suggests the nearest subcommand for an unknown one."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the subcommand that *args* start with; raise UsageError with a suggestion."""
        # resilient_parsing is shell completion, which must not fail on half a word.
        if self.get_command(ctx, args[0]) is None and not ctx.resilient_parsing:
            names = self.list_commands(ctx)
            hint = suggest(args[0], names) or f"; known commands: {', '.join(names)}"
            raise click.UsageError(f"unknown command {args[0]!r}{hint}", ctx)
        return super().resolve_command(ctx, args)


class LazyGroup(CommandGroup):
    """Group that imports a subcommand's module when it is used.

    Args:
        commands_at: ``module:attribute`` of each subcommand.
        summaries: Lines of the group's help page, so that it imports no subcommand.
        former_names: Hidden former names of subcommands, with the present ones.
        **settings: Arguments of ``click.Group``.
    """

    def __init__(
        self,
        *,
        commands_at: Mapping[str, str],
        summaries: Mapping[str, str] = MappingProxyType({}),
        former_names: Mapping[str, str] = MappingProxyType({}),
        **settings: Any,
    ) -> None:
        super().__init__(**settings)
        self._commands_at = commands_at
        self._summaries = summaries
        self._former_names = former_names

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Name every subcommand without importing one."""
        return sorted(self._commands_at)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one subcommand."""
        target = self._commands_at.get(self._former_names.get(cmd_name, cmd_name))
        if target is None:
            return None
        module, _, attribute = target.partition(":")
        command: click.Command = getattr(import_module(module), attribute)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the subcommands with their summaries."""
        if not self._summaries:
            super().format_commands(ctx, formatter)
            return
        # click reads the summaries from the commands, whose modules take 30 ms to import.
        with formatter.section("Commands"):
            formatter.write_dl([(name, self._summaries[name]) for name in sorted(self._summaries)])

    def main(self, *args: Any, **extra: Any) -> NoReturn:
        """Run one command line and end the process; arguments as for ``click.Command.main``."""
        # click's own handling of errors would print two lines and other exit codes.
        extra["standalone_mode"] = False
        try:
            code = super().main(*args, **extra)
        except SystemExit:  # click ends this way when a pipe breaks
            if _has_reader_left():
                sys.exit(ExitCode.DONE)
            raise
        except Exception as exc:  # noqa: BLE001  the outermost edge of the process
            _report(exc)
            sys.exit(exit_code_of(exc))
        sys.exit(code if isinstance(code, int) else ExitCode.DONE)


def exit_code_of(error: Exception) -> int:
    """Return the exit code of an error."""
    if isinstance(error, click.ClickException):
        return error.exit_code
    if isinstance(error, (ConfigError, EnvironmentalError)):
        return ExitCode.UNUSABLE
    return ExitCode.FAILED


def describe(error: Exception) -> str:
    """Return an error in words for a person: one line, or one for each cause if it has several."""
    if isinstance(error, ConfigError):
        return str(error)
    if isinstance(error, click.UsageError):
        command = f"{error.ctx.command_path}: " if error.ctx else ""
        hint = f" (see '{error.ctx.command_path} --help')" if error.ctx else ""
        text = f"{command}{error.format_message()}{hint}"
    elif isinstance(error, click.ClickException):
        text = error.format_message()
    elif isinstance(error, click.Abort):
        text = "interrupted"
    elif isinstance(error, OSError):
        text = describe_os_error(error)
    elif isinstance(error, EapError):
        text = str(error) or type(error).__name__
    else:
        text = f"unexpected {type(error).__name__}: {error} ({DEBUG_VARIABLE}=1 shows where)"
    text = "; ".join((text, *_notes_of(error)))
    # One line whatever the text holds, unless it has several causes: scripts read stderr by lines.
    has_lines = isinstance(error, EapError) and error.has_lines
    lines = text.split(_NEXT_CAUSE) if has_lines else [text]
    return _NEXT_CAUSE.join(" ".join(line.split()) for line in lines)


def _has_reader_left() -> bool:
    """Return whether stdout broke, as in ``--help | head``, and not a socket."""
    import select

    poll = select.poll()
    poll.register(1, 0)
    return any(events & select.POLLERR for _, events in poll.poll(0))


def _notes_of(error: BaseException) -> Sequence[str]:
    """Return the notes of an error; click hides a KeyboardInterrupt behind its own exception."""
    cause = error.__cause__ if isinstance(error, click.Abort) else None
    notes: Sequence[str] = getattr(cause or error, "__notes__", ())
    return notes


def _report(error: Exception) -> None:
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        error.show()
        return
    if os.environ.get(DEBUG_VARIABLE, "0") not in {"", "0"}:
        import traceback

        traceback.print_exception(error)
    click.echo(describe(error), err=True)


_COMMANDS = {
    "addresses": (
        "addresses:addresses",
        "Show the addresses of variables in data blocks and registers.",
    ),
    "apply": ("change:apply", "Apply a plant file to the running plant."),
    "bus": ("bus:bus", "Scan, diagnose and access the slaves of a bus."),
    "check": ("plant:check", "Check a plant file and report all errors."),
    "decode": ("decode:decode", "Decode a frame, or the frames of a capture."),
    "discover": ("discover:discover", "Find the process data on a network, and who takes it."),
    "export": ("recordings:export", "Write a recording as CSV, Parquet, MCAP or pcapng."),
    "export-peer": ("files:export_peer", "Write what TwinCAT needs to talk to a station."),
    "gateway": ("gateway:gateway", "Start, stop and show the mailbox gateways of a station."),
    "gw": ("gateway:gw", "Access a master and its slaves through any mailbox gateway."),
    "import": ("files:import_files", "Make a plant file of TwinCAT, ENI and ESI files."),
    "inventory": ("inventory:inventory", "Print the hosts of a plant file for Ansible."),
    "keys": ("keys:keys", "Make and change keys of signed process data."),
    "log": ("log:log", "Show or set the log levels of running plants."),
    "new": ("plant:new", "Write a plant file to start from."),
    "od": ("od:od", "Read and write the object dictionary of a device."),
    "pd": ("pd:pd", "List, watch and set the process data of running stations."),
    "plot": ("plot:plot", "Draw values of recordings or of a running station."),
    "plan": ("change:plan", "Show the differences between a plant file and the running plant."),
    "record": ("record:record", "Record values and frames, and describe recordings."),
    "replay": ("replay:replay", "Send recorded frames or values again as their publishers."),
    "rollback": ("change:rollback", "Undo the last change of a running plant."),
    "routes": ("routes:routes", "Show, add, remove and test AMS routes; live without a command."),
    "run": ("plant:run", "Run a plant, or some of its stations."),
    "scan": ("network:scan", "List stations, ports and slaves of the whole plant."),
    "sim": ("sim:sim", "Run simulated slaves, and inject faults."),
    "state": ("od:state", "Show or request the state of a station or slave."),
    "status": ("status:status", "Show errors, stations, ports, process data and processes."),
    "top": ("top:top", "Watch stations, process data, buses, routes and events live."),
    "types": ("types:types", "Show the data types of a plant file with their layout."),
    "web": ("web:web", "Serve pages of a plant to browsers, with a JSON API."),
    "trace": ("network:trace", "Show the path to a device, and the hop that failed."),
}
"""BusAddress of each command below ``eap.cli``, and its line in the help."""


def _show_version(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        from importlib.metadata import version

        from eap.compiled import cyclic

        path = "in Python" if cyclic is None else "compiled"
        click.echo(f"eapctl {version('eap-appliance')} (cyclic path {path})")
        context.exit()


@click.group(
    cls=LazyGroup,
    commands_at={name: f"eap.cli.{place}" for name, (place, _) in _COMMANDS.items()},
    summaries={name: summary for name, (_, summary) in _COMMANDS.items()},
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=_show_version,
    help="Show the release, and whether the cyclic path is compiled.",
)
def main() -> None:
    """Run, configure and diagnose stations of the EtherCAT Automation Protocol (EAP).

    Exit codes: 0 done, 1 refused or failed, 2 usage, configuration or environment.
    """
