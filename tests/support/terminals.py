"""Digital terminals as vendors describe them, one PDO of one bit a channel, and a bus of them."""

from __future__ import annotations

from pathlib import Path

from devicebus.master.master import Master
from eap.runtime.busfile import load_or_raise
from tests.support.busline import Paced

DI8, DO8, DI4 = 0x03F0_3052, 0x07D8_3052, 0x03EC_3052
BUS = f"""
bus: terminals
slaves:
  - {{name: coupler, kind: coupler, mailbox: null, clock: null}}
  - {{name: di8, kind: esi, esi: terminals.xml, product: 0x{DI8:08X}}}
  - {{name: do8, kind: esi, esi: terminals.xml, product: 0x{DO8:08X}}}
  - {{name: di4, kind: esi, esi: terminals.xml, product: 0x{DI4:08X}}}
"""
SIZES = [(0, 0), (0, 1), (1, 0), (0, 1)]
"""Bytes of outputs and inputs of each of them."""


def esi() -> str:
    """Return the ESI file of the three terminals."""
    devices = [
        _device(DI8, "DI8", "TxPdo", 0x1A00, 0x6000, 8),
        _device(DO8, "DO8", "RxPdo", 0x1600, 0x7000, 8),
        _device(DI4, "DI4", "TxPdo", 0x1A00, 0x6000, 4),
    ]
    return (
        '<?xml version="1.0"?>\n<EtherCATInfo><Vendor><Id>#x00000E5A</Id><Name>Example</Name>'
        f"</Vendor><Descriptions><Devices>{''.join(devices)}</Devices></Descriptions>"
        "</EtherCATInfo>"
    )


def write_bus(folder: Path) -> Path:
    """Write the ESI file and the bus file; return the path of the latter."""
    (folder / "terminals.xml").write_text(esi())
    path = folder / "terminals.yaml"
    path.write_text(BUS)
    return path


def master_of(path: Path) -> Master:
    """Return our master after it has brought the slaves of a bus file to OP, in memory."""
    line = Paced(Master(), load_or_raise(path).build().segment)
    line.wait(line.core.bring_up(line.now_ns))
    return line.core


def sizes_of(path: Path) -> list[tuple[int, int]]:
    """Return the bytes of outputs and inputs of each slave, as our master exchanges them."""
    places = master_of(path).image.layout.slaves.values()
    return [(place.outputs_size, place.inputs_size) for place in places]


def _device(code: int, name: str, tag: str, first_pdo: int, first: int, channels: int) -> str:
    pdos = "".join(
        f'<{tag} Sm="0" Fixed="1"><Index>#x{first_pdo + number:04X}</Index>'
        f"<Name>Channel {number + 1}</Name><Entry><Index>#x{first + 0x10 * number:04X}</Index>"
        "<SubIndex>1</SubIndex><BitLen>1</BitLen><Name>Signal</Name><DataType>BOOL</DataType>"
        f"</Entry></{tag}>"
        for number in range(channels)
    )
    # The layout of real terminals: outputs in registers of the controller, inputs in its memory.
    outputs = '<Sm StartAddress="#x0f00" ControlByte="#x44" Enable="1">Outputs</Sm>'
    inputs = '<Sm StartAddress="#x1000" ControlByte="#x00" Enable="1">Inputs</Sm>'
    manager = outputs if tag == "RxPdo" else inputs
    return (
        f'<Device Physics="KK"><Type ProductCode="#x{code:08X}" RevisionNo="#x00100000">{name}'
        f"</Type><Name>{name}</Name>{manager}{pdos}</Device>"
    )
