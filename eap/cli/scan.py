"""``eapctl scan``: the stations of a plant, their ports and slaves, by one connection."""

from __future__ import annotations

import click

from eap.cli.output import write_json, write_tables
from eap.cli.params import examples, json_option, plant_option


@click.command(
    short_help="List stations, ports and slaves of the whole plant.",
    epilog=examples("eapctl scan", "eapctl scan --via island-02 --json"),
)
@click.option("--via", metavar="STATION", help="The router of this station asks, not of the first.")
@plant_option
@json_option("Print one object: stations, with their ports and slaves.")
def scan(via: str | None, plant: str | None, as_json: bool) -> None:
    """Ask the stations of the plant, here and behind routes, for their ports and slaves.

    Each line ends with what connects pyads to it; its name is what 'eapctl od', 'state' and 'trace'
    take.  A station or bus that does not answer is shown as the plant file has it, with the reason
    on stderr.
    """
    from eap.appliance.commands import ams
    from eap.cli.scan_view import fault_lines, scan_table  # rich; --help must not wait for it

    answers = ams.scan(plant, via)
    if as_json:
        stations = [station for answer in answers for station in answer["stations"]]
        write_json({"stations": stations, "via": [answer["via"] for answer in answers]})
    for answer in answers:
        if not as_json:
            write_tables([scan_table(answer)])
        for line in fault_lines(answer):
            click.echo(line, err=True)
