"""PLANT and ``--station`` of the commands that change a running plant."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from eap.cli.change import keep_going_option, plant_arguments, running_plant
from eap.config.new_plant import Shape, plant_text
from eap.errors import ConfigError, ControlError
from eap.ops.plant import load_or_raise
from tests.support.plantstub import PlantStub


@click.command()
@plant_arguments
@keep_going_option
def show(plant, stations, local, keep_going):
    click.echo(f"{plant} {stations} {local} {keep_going}")


def test_command_line():
    words = ["a.yaml", "--station", "x", "--station", "y", "--keep-going", "--local"]
    assert CliRunner().invoke(show, words).output == "a.yaml ('x', 'y') True True\n"
    assert CliRunner().invoke(show, ["a.yaml"]).output == "a.yaml () False False\n"


def test_connection(tmp_path, runtime):
    file = tmp_path / "ring.yaml"
    with pytest.raises(ConfigError), running_plant(file, (), local=False):
        pass
    file.write_text(plant_text("ring", 2, Shape.RING))
    with (
        pytest.raises(ControlError, match="no station of plant ring"),
        running_plant(file, (), local=False),
    ):
        pass
    plant = load_or_raise(file)
    with ExitStack() as stack:
        PlantStub("ring", plant.stations, stack)
        with running_plant(file, ("station-02",), local=False) as (link, wanted):
            assert link.stations == ("station-01", "station-02")
            assert wanted == {"station-02": plant.stations[1]}


def test_path_type():
    assert isinstance(show.params[0].type.convert("a", None, None), Path)
