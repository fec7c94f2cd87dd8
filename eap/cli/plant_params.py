"""What ``eapctl plan``, ``apply`` and ``rollback`` have in common: PLANT and ``--station``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.params import PLANT_FILE, CommandT

if TYPE_CHECKING:
    from eap.appliance.commands.plant_link import PlantLink
    from eap.pd.spec import StationSpec


def plant_arguments(command: CommandT) -> CommandT:
    """Add PLANT and ``--station``."""
    stations = click.option(
        "--station",
        "stations",
        multiple=True,
        metavar="NAME",
        help="Only this station; may be given several times.",
    )
    return click.argument("plant", type=PLANT_FILE)(stations(command))


keep_going_option = click.option(
    "--keep-going", is_flag=True, help="Go on with the other stations when one refuses."
)


@contextmanager
def running_plant(
    file: Path, wanted: tuple[str, ...]
) -> Iterator[tuple[PlantLink, dict[str, StationSpec]]]:
    """Connect to what runs of the plant in *file*, for the length of a block.

    Yields:
        The connections, and what the *wanted* stations are to be, which is all that run here
        unless some are named.
    """
    from eap.appliance.commands.plant_change import choose, load_or_raise
    from eap.appliance.commands.plant_link import link_to

    plant = load_or_raise(file)
    with link_to(plant, file) as link:
        yield link, choose(plant, link, wanted)
