"""``eapctl bus``: look at a bus of slaves and talk to them."""

from __future__ import annotations

from pathlib import Path

import click

from eap.cli.bus_params import (
    number_up_to,
    parse_octets,
    slave_argument,
)
from eap.cli.bus_place import BusCommand, BusPort, Place, bus_options, open_session
from eap.cli.group import LazyGroup
from eap.cli.output import write_json, write_tables, write_text
from eap.cli.params import examples, json_option

STATES = ("INIT", "PREOP", "BOOT", "SAFEOP", "OP")
_U32 = 0xFFFFFFFF
_U16 = 0xFFFF


@click.group(
    cls=LazyGroup,
    commands_at={
        "diag": "eap.cli.bus:diag",
        "foe": "eap.cli.bus_foe:foe",
        "idn": "eap.cli.bus_idn:idn",
        "scan": "eap.cli.bus:scan",
        "sdo": "eap.cli.bus_sdo:sdo",
        "sii": "eap.cli.bus:sii",
        "state": "eap.cli.bus:state",
        "voe": "eap.cli.bus:voe",
    },
    epilog=examples(
        "eapctl bus scan island-02/bus0",
        "eapctl bus sdo read island-01/bus0 drive 0x1018:1",
        "eapctl bus foe put island-01/bus0 drive new.bin firmware.bin",
        "eapctl bus scan --interface udp://127.0.4.1",
    ),
)
def bus() -> None:
    """Look at a bus of slaves and talk to them.

    The bus is a port of a running station (STATION/PORT), whose master is asked, or is behind an
    interface (--interface URI), where the command is the master.  SLAVE is a station address (1001
    is the first slave) or the slave's name.  Slaves stay in their states, except that behind an
    interface one in INIT is brought to PREOP when its mailbox is needed.
    """


@click.command(cls=BusCommand)
@bus_options
@json_option("Print one object.")
def scan(bus: Place, as_json: bool) -> None:
    """Show all slaves: identity, state, alias, mailbox protocols."""
    from eap.appliance.commands.bus_info import fault_lines, scan_rows

    with open_session(bus) as session:
        rows = scan_rows(session)
    if as_json:
        write_json({"slaves": rows})
        return
    from eap.cli.bus_view import scan_tables

    write_tables(scan_tables(rows, fault_lines(rows)))


@click.command(cls=BusCommand)
@bus_options
@click.argument("words", nargs=-1, metavar="[SLAVE] [INIT|PREOP|SAFEOP|OP|BOOT]")
@json_option("Print one object.")
def state(words: tuple[str, ...], bus: Place, as_json: bool) -> None:
    """Show states, or bring slaves to a state.

    One slave, or all of them.  The master of a running station keeps them there.  Behind an
    interface nobody does: a slave with outputs leaves OP when nobody sends it process data.
    """
    from eap.appliance.commands.bus_info import state_rows

    target = words[-1].upper() if words and words[-1].upper() in STATES else None
    rest = words[:-1] if target else words
    if len(rest) > 1:
        raise click.UsageError(f"{rest[-1]!r} is not a state, expected one of {', '.join(STATES)}")
    with open_session(bus) as session:
        rows = state_rows(session, rest[0] if rest else None, target)
    if as_json:
        write_json({"slaves": rows})
        return
    from eap.cli.bus_view import state_table

    write_tables([state_table(rows)])
    if target is not None and isinstance(bus, BusPort):
        write_text(f"\nThe master of {bus} keeps {'it' if rest else 'them'} there.")


@click.command(cls=BusCommand)
@bus_options
@click.argument("slave", required=False, metavar="[SLAVE]")
@click.option("--full", is_flag=True, help="Show slaves without errors too, however many.")
@click.option("--reset", is_flag=True, help="Clear error counters, forget what is over.")
@json_option("Print one object.")
def diag(slave: str | None, bus: Place, full: bool, reset: bool, as_json: bool) -> None:
    """Show what is wrong with a bus, and what was.

    One line for each cause, below a table of states and error counters of ports.  A running station
    tells since when, or until when; behind an interface the counters are those since the slaves
    were switched on, or the last --reset.
    """
    if reset:
        if slave is not None:
            raise click.UsageError("--reset is for the whole bus: leave SLAVE out")
        _reset(bus, as_json=as_json)
        return
    from time import time

    from eap.appliance.commands.bus_info import diagnosis

    with open_session(bus) as session:
        found = diagnosis(session, slave, time())
    if as_json:
        write_json(found)
        return
    from eap.cli.bus_view import diagnosis_tables

    write_tables(diagnosis_tables(found, time(), is_full=full))


def _reset(bus: Place, *, as_json: bool) -> None:
    from eap.appliance.commands.bus_info import reset_diagnosis
    from eap.cli.words import count

    with open_session(bus) as session:
        done = reset_diagnosis(session)
    if as_json:
        write_json(done)
    else:
        write_text(f"error counters of {count(len(done['reset']), 'slave')} cleared")


@click.group()
def sii() -> None:
    """Read and write the EEPROM of a slave."""


@sii.command("dump", cls=BusCommand)
@bus_options
@slave_argument
@click.argument("file", required=False, type=click.Path(path_type=Path, dir_okay=False))
@json_option("Print one object, with all octets in hexadecimal digits.")
def sii_dump(slave: str, file: Path | None, bus: Place, as_json: bool) -> None:
    """Read the EEPROM; with FILE, store its octets there."""
    from eap.appliance.commands.bus_info import read_eeprom
    from eap.appliance.durable import whole_file

    with open_session(bus) as session:
        content, image = read_eeprom(session, slave)
    if file is not None:
        with whole_file(file) as target:
            target.write(image)
    if as_json:
        write_json(content | {"data": image.hex()})
        return
    from eap.cli.bus_view import eeprom_lines

    write_text("\n".join(eeprom_lines(content, b"" if file else image)))


@sii.command("write", cls=BusCommand)
@bus_options
@slave_argument
@click.argument("file", type=click.Path(exists=True, path_type=Path, dir_okay=False))
@json_option("Print one object.")
def sii_write(slave: str, file: Path, bus: Place, as_json: bool) -> None:
    """Write FILE into the EEPROM and compare what is there then.

    The master of a running station takes note of it when it brings its bus up anew.
    """
    from eap.appliance.commands.bus_info import write_eeprom

    with open_session(bus) as session:
        done = write_eeprom(session, slave, file.read_bytes())
    if as_json:
        write_json(done)
    else:
        write_text(f"slave {done['address']}: {done['octets']} octets written and compared")
        if isinstance(bus, BusPort):
            write_text(
                f"\nThe master of {bus} goes by the old content until its plant starts again."
            )


@click.command(cls=BusCommand)
@bus_options
@slave_argument
@click.argument("data", type=parse_octets, metavar="HEX")
@click.option("--vendor", type=number_up_to(_U32), required=True, metavar="ID", help="Vendor ID.")
@click.option(
    "--vendor-type",
    type=number_up_to(_U16),
    default=0,
    metavar="TYPE",
    help="What the vendor makes of it.",
)
@json_option("Print one object.")
def voe(slave: str, data: bytes, vendor: int, vendor_type: int, bus: Place, as_json: bool) -> None:
    """Send a message of a vendor's own protocol and print the answer."""
    from eap.appliance.commands.bus_foe import exchange

    with open_session(bus) as session:
        answer = exchange(session, slave, vendor, vendor_type, data)
    if as_json:
        write_json(answer)
    else:
        write_text(answer["data"])
