"""Man pages of all commands, from their help.

    python -m tools.package.manpages FOLDER

Pages are named as git's: ``eapctl.1``, ``eapctl-pd-set.1``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from inspect import cleandoc
from pathlib import Path

import click

from eap.cli.group import main as eapctl

_HEAD = '.TH "{title}" "1" "{date}" "eap-appliance {version}" "EAP appliance"'


def pages(version: str, date: str) -> Iterator[tuple[str, str]]:
    """Yield the file name and the text of each page; *date* is that of the release."""
    for ctx in _contexts(click.Context(eapctl, info_name="eapctl", **eapctl.context_settings)):
        name = ctx.command_path.replace(" ", "-")
        head = _HEAD.format(title=name.upper(), date=date, version=version)
        yield f"{name}.1", "\n".join([head, *_page(ctx, name)]) + "\n"


def _contexts(ctx: click.Context) -> Iterator[click.Context]:
    yield ctx
    for name, command in _subcommands(ctx):
        yield from _contexts(click.Context(command, info_name=name, parent=ctx))


def _subcommands(ctx: click.Context) -> Iterator[tuple[str, click.Command]]:
    if isinstance(ctx.command, click.Group):
        for name in ctx.command.list_commands(ctx):
            command = ctx.command.get_command(ctx, name)
            if command is not None and not command.hidden:
                yield name, command


def _page(ctx: click.Context, name: str) -> Iterator[str]:
    command = ctx.command
    yield ".SH NAME"
    yield f"{_roff(name)} \\- {_roff(_summary(command))}"
    yield ".SH SYNOPSIS"
    usage = command.get_usage(ctx).removeprefix("Usage:").split("\n")
    yield from _lines([f"\\fB{_roff(' '.join(line.split()))}\\fR\n.br" for line in usage])
    yield ".SH DESCRIPTION"
    yield from _text(cleandoc(command.help or ""))
    options = [param for param in command.get_params(ctx) if isinstance(param, click.Option)]
    records = [record for each in options if (record := each.get_help_record(ctx)) is not None]
    if records:
        yield ".SH OPTIONS"
        for names, text in records:
            yield f".TP\n\\fB{_roff(names)}\\fR"
            yield from _text(text)
    subcommands = list(_subcommands(ctx))
    if subcommands:
        yield ".SH COMMANDS"
        for sub, each in subcommands:
            yield f".TP\n\\fB{_roff(name)}\\-{_roff(sub)}\\fR(1)"
            yield from _text(_summary(each))
    if command.epilog:
        yield ".SH EXAMPLES"
        yield from _text(cleandoc(command.epilog).replace("Examples:\n", "", 1))
    if ctx.parent is None:
        yield from _main_sections()
    else:
        parent = ctx.parent.command_path.replace(" ", "-")
        yield f".SH SEE ALSO\n\\fB{_roff(parent)}\\fR(1)"


def _main_sections() -> Iterator[str]:
    yield ".SH FILES"
    for path, text in (
        ("/etc/eap/PLANT.yaml", "plant files of the service eap@PLANT"),
        ("/var/lib/eap", "its configurations changed at run time, and its audit"),
        ("/run/eap", "its control sockets and process images"),
    ):
        yield f".TP\n\\fI{_roff(path)}\\fR"
        yield from _text(text)
    yield ".SH ENVIRONMENT"
    for variable, text in (
        ("EAP_RUNTIME_DIR", "folder in which running appliances are found"),
        ("EAP_STATE_DIR", "folder of configurations and audit"),
        ("EAP_DEBUG", "1 prints a traceback above the line of an error"),
    ):
        yield f".TP\n\\fB{variable}\\fR"
        yield from _text(text)


def _summary(command: click.Command) -> str:
    return (command.help or "").split("\n\n")[0].replace("\n", " ").strip().rstrip(".")


def _text(text: str) -> Iterator[str]:
    """Yield paragraphs; those with a mark of click's are kept as they are."""
    for number, paragraph in enumerate(text.split("\n\n")):
        if number:
            yield ".PP"
        if paragraph.startswith("\b"):
            lines = map(_roff, paragraph.removeprefix("\b").strip("\n").split("\n"))
            yield from (".nf", *_lines(lines), ".fi")
        else:
            yield from _lines([_roff(" ".join(paragraph.split()))])


def _lines(lines: list[str] | map[str]) -> Iterator[str]:
    """Yield lines that are no requests, whatever they begin with."""
    for line in lines:
        yield f"\\&{line}" if line.startswith((".", "'")) else line


def _roff(text: str) -> str:
    return text.replace("\\", "\\e").replace("-", "\\-")


def main(arguments: list[str]) -> int:
    """Write all pages to a folder; return the exit status."""
    from tools.package.version import version

    for name, text in pages(version(), ""):
        (Path(arguments[0]) / name).write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
