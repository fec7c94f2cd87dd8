"""``eapctl inventory``: the hosts of a plant file for Ansible."""

from __future__ import annotations

from pathlib import Path

import click

from eap.cli.output import write_json
from eap.cli.params import PLANT_FILE, examples


@click.command(epilog=examples("eapctl inventory line.yaml --list"))
@click.argument("plant", type=PLANT_FILE)
@click.option("--list", "is_list", is_flag=True, help="Print all hosts and groups; the default.")
@click.option("--host", metavar="NAME", help="Print the variables of one host.")
@click.option("--json", "is_json", is_flag=True, help="Print JSON, as without it.")
def inventory(plant: Path, is_list: bool, host: str | None, is_json: bool) -> None:
    """Print the hosts of PLANT as an Ansible inventory, a JSON object.

    Ansible runs an executable file with --list or --host NAME as an inventory script;
    deploy/ansible/inventory of the sources is one.
    """
    from eap.ops import inventory as operations
    from eap.ops.plant import load_or_raise

    del is_json
    if is_list and host is not None:
        raise click.UsageError("--list and --host NAME exclude each other")
    loaded = load_or_raise(plant)
    write_json(
        operations.inventory(loaded, plant)
        if host is None
        else operations.host_variables(loaded, host)
    )
