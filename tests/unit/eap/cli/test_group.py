from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from devicebus.errors import BusError
from eap.cli.group import ExitCode, LazyGroup, main
from eap.errors import ConfigError, ControlError, EnvironmentalError, ImageError

SLOW = {"asyncio", "dpkt", "msgspec", "rich", "socket", "textual", "yaml"}


class Failing(LazyGroup):
    """A group whose only command raises."""

    error: BaseException = SystemExit(0)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
        def fail() -> None:
            raise self.error

        return click.Command(cmd_name, callback=fail)


def failing(error: BaseException) -> Failing:
    group = Failing(commands_at={"x": "eap.cli:main"}, name="eapctl")
    group.error = error
    return group


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (ConfigError("p.yaml:1: wrong\np.yaml:2: too"), 2, "p.yaml:1: wrong\np.yaml:2: too\n"),
        (EnvironmentalError("no such interface"), 2, "no such interface\n"),
        (ImageError("no variable"), 1, "no variable\n"),
        (ControlError("refused\n  by all"), 1, "refused by all\n"),
        (BusError("not as expected:\n  a is missing"), 1, "not as expected:\n  a is missing\n"),
        (click.UsageError("wrong words"), 2, "eapctl x: wrong words (see 'eapctl x --help')\n"),
        (click.ClickException("failed"), 1, "failed\n"),
        (FileNotFoundError(errno.ENOENT, "No such file", "x"), 1, "x: No such file\n"),
        (OSError(errno.ENOSPC, "No space left"), 1, "No space left\n"),
        (TimeoutError(), 1, "TimeoutError\n"),
        (KeyError("a"), 1, "unexpected KeyError: 'a' (EAP_DEBUG=1 shows where)\n"),
        (KeyboardInterrupt(), 1, "\ninterrupted\n"),
    ],
)
def test_every_error_becomes_a_line_and_a_code(
    error: BaseException, code: int, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("EAP_DEBUG", raising=False)
    result = CliRunner().invoke(failing(error), ["x"])
    assert (result.exit_code, result.stderr, result.stdout) == (code, text, "")


def test_debug_shows_where(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EAP_DEBUG", "1")
    result = CliRunner().invoke(failing(KeyError("a")), ["x"])
    assert result.exit_code == 1
    assert result.stderr.startswith("Traceback (most recent call last):")


def test_exit_code_of_a_command_is_kept() -> None:
    assert CliRunner().invoke(failing(click.exceptions.Exit(2)), ["x"]).exit_code == 2


@pytest.mark.parametrize(("module", "path"), [(None, "in Python"), (object(), "compiled")])
def test_version_says_whether_the_cyclic_path_is_compiled(module, path, monkeypatch):
    monkeypatch.setattr("eap.compiled.cyclic", module)
    result = CliRunner().invoke(main, ["--version"])
    assert result.exit_code == ExitCode.DONE
    assert re.fullmatch(rf"eapctl \S+ \(cyclic path {path}\)\n", result.stdout)


def test_usage_errors_name_the_command() -> None:
    result = CliRunner().invoke(main, ["pd", "watch"], prog_name="eapctl")
    assert result.exit_code == 2
    assert result.stderr == (
        "eapctl pd watch: Missing argument 'STATION [VAR]...'. (see 'eapctl pd watch --help')\n"
    )


def test_unknown_command_without_a_suggestion_names_all() -> None:
    result = CliRunner().invoke(main, ["xyzzy"], prog_name="eapctl")
    assert result.exit_code == 2
    assert "unknown command 'xyzzy'; known commands: " in result.stderr


def test_no_command_shows_the_help() -> None:
    result = CliRunner().invoke(main, [])
    assert result.exit_code == 2
    assert all(name in result.output for name in ("check", "decode", "pd", "run", "status"))


def commands(group: click.Group, path: str) -> Iterator[tuple[str, click.Command]]:
    with click.Context(group) as ctx:
        for name in group.list_commands(ctx):
            command = group.get_command(ctx, name)
            assert command
            if isinstance(command, click.Group):
                yield from commands(command, f"{path}{name} ")
            else:
                yield path + name, command


def test_documentation_shows_every_command_with_all_its_options() -> None:
    text = Path("docs/commands.md").read_text()
    sections = dict(part.split("\n", 1) for part in text.split("\n## ")[1:])
    documented = {name for name, _ in commands(main, "")}
    assert documented == set(sections) - {"Common behaviour"}
    for name, command in commands(main, ""):
        for parameter in command.params:
            if isinstance(parameter, click.Option):
                options = [*parameter.opts, *parameter.secondary_opts]
                assert all(option in sections[name] for option in options), (name, options)


HELP = [
    [],
    ["bus"],
    ["bus", "foe", "put"],
    ["bus", "idn", "read"],
    ["bus", "scan"],
    ["bus", "sdo", "read"],
    ["check"],
    ["decode"],
    ["od", "write"],
    ["pd"],
    ["pd", "watch"],
    ["pd", "set"],
    ["plan"],
    ["apply"],
    ["new"],
    ["routes"],
    ["routes", "add"],
    ["run"],
    ["sim", "fault"],
    ["state"],
    ["status"],
]


def test_notes_on_an_error_follow_it() -> None:
    for error, text in ((ControlError("refused"), "refused"), (KeyboardInterrupt(), "interrupted")):
        error.add_note("3 of 4 were done")
        result = CliRunner().invoke(failing(error), ["x"])
        assert result.stderr.lstrip() == f"{text}; 3 of 4 were done\n"


@pytest.mark.net
def test_help_for_a_reader_that_left_is_done() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as closed:
        words = [sys.executable, "-m", "eap", "bus", "--help"]
        done = subprocess.run(words, stdout=closed, stderr=subprocess.PIPE, check=False)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.net
@pytest.mark.parametrize("words", HELP)
def test_help_imports_nothing_slow(words: list[str]) -> None:
    script = (
        "import sys; from eap.cli.group import main\n"
        "try: main(sys.argv[1:])\n"
        "finally: print('\\n'.join(sys.modules), file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, *words, "--help"], capture_output=True, text=True, check=True
    )
    assert "Usage:" in done.stdout
    assert not SLOW & set(done.stderr.split())
