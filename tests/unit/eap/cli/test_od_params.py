"""TARGET on a command line."""

from __future__ import annotations

import click
from click.testing import CliRunner

from eap.cli.od import target_argument


@click.command()
@target_argument
@click.argument("word")
def show(word, target):
    click.echo(f"{target} {target.plant} {word}")


def test_target_comes_first():
    assert CliRunner().invoke(show, ["a/b", "x", "--plant", "p"]).output == "a/b p x\n"
    assert CliRunner().invoke(show, ["a", "x"]).output == "a None x\n"


def test_invalid_target_is_refused():
    result = CliRunner().invoke(show, ["a/", "x"])
    assert result.exit_code == 2
    assert "'a/' is not STATION" in result.output
