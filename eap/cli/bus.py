"""``eapctl bus``: slaves of a bus, their objects, IDNs, files and EEPROMs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.group import CommandGroup, LazyGroup
from eap.cli.output import CommandT, Renderer, json_option
from eap.cli.params import (
    BusAddress,
    BusCommand,
    StationBus,
    bus_options,
    check_new_file,
    examples,
    number_up_to,
    open_session,
    parse_entry,
    parse_octets,
    parse_type,
    slave_argument,
)
from eap.quantities import times

if TYPE_CHECKING:
    from eap.codec.datatypes import DataType
    from eap.codec.soe import Idn
    from eap.ids import ObjectId
    from eap.ops.bus_foe import FileTransfer
    from eap.ops.scanned_bus import WrittenBus

STATES = ("INIT", "PREOP", "BOOT", "SAFEOP", "OP")
_U32 = 0xFFFFFFFF
_U16 = 0xFFFF
_MAX_DRIVE = 7
_STANDARD = Path("-")


@click.group(
    cls=LazyGroup,
    commands_at={
        name: f"eap.cli.bus:{name}"
        for name in ("diag", "foe", "idn", "scan", "sdo", "sii", "state", "voe")
    },
    epilog=examples(
        "eapctl bus scan island-02/bus0",
        "eapctl bus sdo read island-01/bus0 drive 0x1018:1",
        "eapctl bus foe put island-01/bus0 drive new.bin firmware.bin",
        "eapctl bus scan --interface udp://127.0.4.1",
    ),
)
def bus() -> None:
    """Scan, diagnose and access the slaves of a bus.

    The bus is a bus port of a running station (STATION/PORT), whose master serves the command; with
    --interface URI the command is the master itself.  SLAVE is a station address (1001 is the first
    slave) or the slave's name.  Slaves keep their states, with one exception: with --interface, a
    slave in INIT is brought to PREOP when its mailbox is needed.
    """


@click.command(
    cls=BusCommand,
    epilog=examples(
        "eapctl bus scan island-02/bus0",
        "eapctl bus scan --interface ethernet://eth1 --write bus.yaml --esi esi/",
    ),
)
@bus_options
@click.option(
    "--write",
    "target",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="BUS.yaml",
    help="Write a bus file that describes the slaves.",
)
@click.option(
    "--esi",
    type=click.Path(exists=True, path_type=Path),
    metavar="PATH",
    help="With --write: ESI files of the vendors, a folder or one file.",
)
@click.option("--force", is_flag=True, help="With --write: overwrite an existing file.")
@json_option("Print one object.")
def scan(
    bus: BusAddress, target: Path | None, esi: Path | None, force: bool, output: Renderer
) -> None:
    """Show all slaves with identity, state, alias and mailbox protocols.

    With --write the process data is read as well, and BUS.yaml describes both, so that the bus port
    of a plant has its variables.  A slave with an ESI file refers to that file; others are
    described by their EEPROM and their objects.
    """
    from eap.cli.bus_view import scan_tables, written_bus_view
    from eap.ops.bus_info import scan_slaves

    if target is None:
        if esi is not None or force:
            raise click.UsageError("--esi and --force belong to --write BUS.yaml")
        with open_session(bus) as session:
            found = scan_slaves(session)
        output.show(found, scan_tables)
        return
    check_new_file(target, force=force)
    output.show(_write_bus(bus, target, esi), written_bus_view)


def _write_bus(bus: BusAddress, target: Path, esi: Path | None) -> WrittenBus:
    from eap.errors import EnvironmentalError
    from eap.ops.scanned_bus import bus_text, describe_slaves, written
    from eap.runtime.durable import whole_file
    from eap.runtime.esi_files import EsiSource

    try:
        source = None if esi is None else EsiSource(esi)
    except OSError as exc:
        raise EnvironmentalError(f"{esi} cannot be read: {exc.strerror}") from None
    with open_session(bus) as session:
        slaves = describe_slaves(session, source)
    with whole_file(target) as file:
        file.write(bus_text(target.stem, target.parent, slaves).encode())
    return written(target, slaves, source)


@click.command(cls=BusCommand)
@bus_options
@click.argument("words", nargs=-1, metavar="[SLAVE] [INIT|PREOP|SAFEOP|OP|BOOT]")
@json_option("Print one object.")
def state(words: tuple[str, ...], bus: BusAddress, output: Renderer) -> None:
    """Show or request the state of one slave, or of all slaves.

    The master of a running station keeps slaves in the requested state.  With --interface no master
    runs afterwards: a slave with outputs leaves OP when it receives no more process data.
    """
    from eap.cli.bus_view import state_view
    from eap.ops.bus_info import slave_states

    # One argument may be either: a slave whose name is that of a state is addressed by its number.
    target = words[-1].upper() if words and words[-1].upper() in STATES else None
    rest = words[:-1] if target else words
    if len(rest) > 1:
        raise click.UsageError(f"{rest[-1]!r} is not a state; expected one of {', '.join(STATES)}")
    with open_session(bus) as session:
        found = slave_states(session, rest[0] if rest else None, target)
    note = ""
    if target is not None and isinstance(bus, StationBus):
        note = f"\nThe master of {bus} keeps {'it' if rest else 'them'} there."
    output.show(found, lambda states: state_view(states, note))


@click.command(cls=BusCommand)
@bus_options
@click.argument("slave", required=False, metavar="[SLAVE]")
@click.option("--full", is_flag=True, help="Show slaves without errors too.")
@click.option("--reset", is_flag=True, help="Clear the error counters and past faults.")
@json_option("Print one object.")
def diag(slave: str | None, bus: BusAddress, full: bool, reset: bool, output: Renderer) -> None:
    """Show present and past faults of a bus.

    Prints a table of the states and the error counters of ports, and below it one line for each
    cause.  The master of a running station knows when a fault began and ended.  With --interface
    the counters are those since the slaves were powered on or since the last --reset.
    """
    from time import time

    from eap.cli.bus_view import diagnosis_view, reset_view
    from eap.ops.bus_info import diagnosis, reset_diagnosis

    if reset and slave is not None:
        raise click.UsageError("--reset clears the counters of the whole bus: omit SLAVE")
    with open_session(bus) as session:
        if reset:
            output.show(reset_diagnosis(session), reset_view)
            return
        found = diagnosis(session, slave, time())
    output.show(found, lambda each: diagnosis_view(each, time(), is_full=full))


@click.group(cls=CommandGroup)
def sii() -> None:
    """Read and write the EEPROM of a slave."""


@sii.command("dump", cls=BusCommand)
@bus_options
@slave_argument
@click.argument("file", required=False, type=click.Path(path_type=Path, dir_okay=False))
@json_option("Print one object, with all bytes in hexadecimal digits.")
def sii_dump(slave: str, file: Path | None, bus: BusAddress, output: Renderer) -> None:
    """Read the EEPROM and print it, or store it in FILE."""
    from eap.cli.bus_view import eeprom_lines
    from eap.ops.bus_info import read_eeprom
    from eap.runtime.durable import whole_file

    with open_session(bus) as session:
        content = read_eeprom(session, slave)
    if file is not None:
        with whole_file(file) as target:
            target.write(bytes.fromhex(content.data))
    output.show(content, lambda each: eeprom_lines(each, has_octets=file is None))


@sii.command("write", cls=BusCommand)
@bus_options
@slave_argument
@click.argument("file", type=click.Path(exists=True, path_type=Path, dir_okay=False))
@json_option("Print one object.")
def sii_write(slave: str, file: Path, bus: BusAddress, output: Renderer) -> None:
    """Write FILE to the EEPROM, read it back and compare.

    The master of a running station reads it at the next start of its plant.
    """
    from eap.ops.bus_info import WrittenEeprom, write_eeprom

    def lines(done: WrittenEeprom) -> Iterator[str]:
        yield f"slave {done.address}: {done.octets} bytes written and verified"
        if isinstance(bus, StationBus):
            yield f"\nThe master of {bus} uses the old content until its plant starts again."

    with open_session(bus) as session:
        done = write_eeprom(session, slave, file.read_bytes())
    output.show(done, lines)


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
    help="Type of the message, defined by the vendor.",
)
@json_option("Print one object.")
def voe(
    slave: str, data: bytes, vendor: int, vendor_type: int, bus: BusAddress, output: Renderer
) -> None:
    """Send a vendor-specific message (VoE) and print the reply."""
    from eap.ops.bus_foe import exchange

    with open_session(bus) as session:
        reply = exchange(session, slave, vendor, vendor_type, data)
    output.show(reply, lambda each: each.data)


def _value_options(command: CommandT) -> CommandT:
    complete = click.option(
        "--complete",
        is_flag=True,
        help="Complete access: the whole object, from INDEX:0 or INDEX:1.",
    )
    kind = click.option(
        "--type",
        "kind",
        type=parse_type,
        metavar="TYPE",
        help="Data type, such as UINT or STRING(16) [default: as the slave describes it]",
    )
    return complete(kind(command))


@click.group(cls=CommandGroup)
def sdo() -> None:
    """Read, write and list the objects of a slave (CoE)."""


@sdo.command("read", cls=BusCommand)
@bus_options
@slave_argument
@click.argument("entry", type=parse_entry, metavar="INDEX[:SUB]")
@_value_options
@json_option("Print one object.")
def sdo_read(
    slave: str,
    entry: ObjectId,
    kind: DataType | None,
    complete: bool,
    bus: BusAddress,
    output: Renderer,
) -> None:
    """Read an entry.

    INDEX and SUB are hexadecimal, with or without 0x: 0x1018:01, 1018:1.
    """
    from eap.cli.bus_view import value_line
    from eap.ops.bus_objects import read_entry

    with open_session(bus) as session:
        found = read_entry(session, slave, *entry, kind=kind, complete=complete)
    output.show(found, value_line)


@sdo.command("write", cls=BusCommand, context_settings={"ignore_unknown_options": True})
@bus_options
@slave_argument
@click.argument("entry", type=parse_entry, metavar="INDEX[:SUB]")
@click.argument("value")
@_value_options
@json_option("Print one object: what was written.")
def sdo_write(
    slave: str,
    entry: ObjectId,
    value: str,
    kind: DataType | None,
    complete: bool,
    bus: BusAddress,
    output: Renderer,
) -> None:
    """Write an entry.

    INDEX and SUB are hexadecimal, with or without 0x: 0x8000:01, 8000:1.  VALUE is a
    literal of the entry's type: 12, 0xC, -1.5e3, true, text; hexadecimal digits for a block and
    with --complete.
    """
    from eap.ops.bus_objects import write_entry

    with open_session(bus) as session:
        done = write_entry(session, slave, *entry, value, kind=kind, complete=complete)
    output.show(done, lambda _: f"{entry} = {value}")


@sdo.command("list", cls=BusCommand)
@bus_options
@slave_argument
@json_option("Print one object a line.")
def sdo_list(slave: str, bus: BusAddress, output: Renderer) -> None:
    """List the objects that the slave describes."""
    from eap.cli.bus_view import object_table
    from eap.ops import bus_objects

    with open_session(bus) as session:
        output.show_rows(bus_objects.list_objects(session, slave), object_table)


@sdo.command("dump", cls=BusCommand)
@bus_options
@slave_argument
@json_option("Print one object a line.")
def sdo_dump(slave: str, bus: BusAddress, output: Renderer) -> None:
    """Read every entry of every object that the slave describes."""
    from eap.cli.bus_view import dump_table
    from eap.ops.bus_objects import dump_entries

    with open_session(bus) as session:
        output.show_rows(dump_entries(session, slave), dump_table)


def parse_idn(text: str) -> Idn:
    """Read S-0-0032 or the 16 bits of an IDN; raise BadParameter with an example otherwise."""
    from eap.codec.soe import Idn

    try:
        if text[:1].isdecimal() and 0 <= int(text, 0) <= 0xFFFF:
            return Idn.of(int(text, 0))
        return Idn.parse(text)
    except ValueError as exc:
        raise click.BadParameter(str(exc)) from None


def _drive_option(command: CommandT) -> CommandT:
    return click.option(
        "--drive",
        type=click.IntRange(0, _MAX_DRIVE),
        default=0,
        show_default=True,
        metavar="N",
        help="Number of the drive in the slave.",
    )(command)


@click.group(cls=CommandGroup)
def idn() -> None:
    """Read, write and list the IDNs of a drive (SoE)."""


@idn.command("read", cls=BusCommand)
@bus_options
@slave_argument
@click.argument("number", type=parse_idn, metavar="IDN")
@_drive_option
@json_option("Print one object.")
def idn_read(slave: str, number: Idn, drive: int, bus: BusAddress, output: Renderer) -> None:
    """Read all elements of an IDN."""
    from eap.cli.bus_view import idn_lines
    from eap.ops.bus_objects import read_idn

    with open_session(bus) as session:
        found = read_idn(session, slave, number, drive=drive)
    output.show(found, idn_lines)


@idn.command("write", cls=BusCommand, context_settings={"ignore_unknown_options": True})
@bus_options
@slave_argument
@click.argument("number", type=parse_idn, metavar="IDN")
@click.argument("value")
@_drive_option
@json_option("Print one object: what was written.")
def idn_write(
    slave: str, number: Idn, value: str, drive: int, bus: BusAddress, output: Renderer
) -> None:
    """Write the value of an IDN.

    Separate the numbers of a list by commas.
    """
    from eap.ops.bus_objects import write_idn

    with open_session(bus) as session:
        done = write_idn(session, slave, number, value, drive=drive)
    output.show(done, lambda each: f"{each.idn} = {value}")


@idn.command("list", cls=BusCommand)
@bus_options
@slave_argument
@_drive_option
@json_option("Print one object a line.")
def idn_list(slave: str, drive: int, bus: BusAddress, output: Renderer) -> None:
    """List all IDNs of a drive."""
    from eap.cli.bus_view import idn_table
    from eap.ops import bus_objects

    with open_session(bus) as session:
        output.show_rows(bus_objects.list_idns(session, slave, drive=drive), idn_table)


def _password_option(command: CommandT) -> CommandT:
    return click.option(
        "--password",
        type=number_up_to(0xFFFFFFFF),
        default=0,
        metavar="N",
        help="Password, if the slave requires one.",
    )(command)


@click.group(cls=CommandGroup)
def foe() -> None:
    """Read and write files of a slave (FoE)."""


@foe.command("get", cls=BusCommand)
@bus_options
@slave_argument
@click.argument("name")
@click.argument("file", required=False, type=click.Path(path_type=Path, dir_okay=False))
@_password_option
@json_option("Print one object; without it a progress bar is on stderr.")
def foe_get(
    slave: str,
    name: str,
    file: Path | None,
    password: int,
    bus: BusAddress,
    output: Renderer,
) -> None:
    """Read the file NAME of a slave into FILE.

    FILE defaults to NAME in this folder; - is stdout.
    """
    from eap.ops.bus_foe import get_file

    target = file or Path(Path(name).name)
    is_stdout = target == _STANDARD
    if is_stdout and output.is_json:
        raise click.UsageError("both the file and --json go to stdout: name a FILE, or omit --json")
    with open_session(bus) as session, _progress(name, hidden=output.is_json) as report:
        whole = None if is_stdout else target
        done = get_file(session, slave, name, whole, password=password, report=report)
    text = _transfer_text(done, f"{done.name} → {done.file}")
    if is_stdout:
        # On stderr: stdout holds the file.
        click.echo(text, err=True)
    else:
        output.show(done, lambda _: text)


@foe.command("put", cls=BusCommand)
@bus_options
@slave_argument
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.argument("name", required=False)
@_password_option
@json_option("Print one object; without it a progress bar is on stderr.")
def foe_put(
    slave: str,
    file: Path,
    name: str | None,
    password: int,
    bus: BusAddress,
    output: Renderer,
) -> None:
    """Write FILE to a slave as NAME; NAME defaults to the file's name.

    FILE - is stdin and needs NAME.
    """
    from eap.ops.bus_foe import put_file

    is_stdin = file == _STANDARD
    if is_stdin and not name:
        raise click.UsageError("a file from stdin has no name: give NAME")
    target = name or file.name
    with open_session(bus) as session, _progress(target, hidden=output.is_json) as report:
        source = None if is_stdin else file
        done = put_file(session, slave, source, target, password=password, report=report)
    output.show(done, lambda each: _transfer_text(each, f"{each.file} → {each.name}"))


def _transfer_text(done: FileTransfer, what: str) -> str:
    text = (
        f"{what}: {done.octets} bytes in {done.seconds:.1f} s, {done.rate / 1000:.0f} kB/s\n"
        f"sha256 {done.sha256}"
    )
    if done.restarts:
        text += f"\nrestarted {times(done.restarts)}: the bus interrupted the transfer"
    return text


@contextmanager
def _progress(name: str, *, hidden: bool) -> Iterator[Callable[[int, int | None, int], None]]:
    """Show a progress bar on stderr, if that is a terminal."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        DownloadColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
        TransferSpeedColumn,
    )

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    # The bar is drawn over itself; in a log it would be a line for each step.
    disable = hidden or not console.is_terminal
    with Progress(*columns, console=console, disable=disable) as bar:
        task = bar.add_task(name, total=None)

        def report(done: int, total: int | None, restarts: int) -> None:
            again = f" (restart {restarts})" if restarts else ""
            bar.update(task, completed=done, total=total, description=f"{name}{again}")

        yield report
