"""Projects of TwinCAT of the tests' own making, with the structure of published ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from eap.config.imports.records import ImportReport
from eap.config.imports.twincat import TwinCatProject, read_project

DEVICE = "Device 1 (EtherCAT Automation Protocol)"
NO_TARGET = 'InOut="1"'


def variable(name: str, nv_id: int, kind: str, length: int, *, sent: bool, more: str = "") -> str:
    """Return a network variable."""
    group, state = ("2", "VarCtrl") if sent else ("1", "VarState")
    direction = 'VarInOut="1" ' if sent else ""
    return f"""\
<EapVar Id="1" {direction}NvId="{nv_id}" NvLength="{length}" {more}><Name>{name}</Name>
<ImageId>97</ImageId><Vars VarGrpType="{group}"><Name>Group</Name>
<Var BoxStateVariable="true"><Name>{state}</Name><Type>UINT</Type><BitOffs>16</BitOffs></Var>
<Var><Name>VarData</Name>{kind}<BitOffs>32</BitOffs></Var></Vars></EapVar>"""


def publisher(
    name: str,
    *variables: tuple[str, int, str, int],
    eap: str = 'InOut="1" Publisher="c0a805020101" ArpRetryInterval="1000"',
    box: str = "",
    more: str = "",
) -> str:
    """Return a publisher with variables: name, ID, type and bytes."""
    inner = "".join(variable(*each, sent=True, more=more) for each in _typed(variables))
    return (
        f'<Box Id="1" BoxType="9051" {box}><Name>{name}</Name><ImageId>99</ImageId>'
        f"<Eap {eap}>{inner}</Eap></Box>"
    )


def subscriber(
    name: str,
    *variables: tuple[str, int, str, int],
    eap: str = 'Publisher="c0a805020101"',
    box: str = "",
) -> str:
    """Return a subscriber with variables: name, ID, type and bytes."""
    inner = "".join(variable(*each, sent=False) for each in _typed(variables))
    return (
        f'<Box Id="2" BoxType="9052" {box}><Name>{name}</Name><ImageId>100</ImageId>'
        f"<Eap {eap}>{inner}</Eap></Box>"
    )


def _typed(variables: Iterable[tuple[str, int, str, int]]) -> Iterable[tuple[str, int, str, int]]:
    for name, nv_id, kind, length in variables:
        text = kind if kind.startswith("<") else f"<Type>{kind}</Type>"
        yield name, nv_id, text, length


def device(*boxes: str, name: str = DEVICE, net_id: str = "192.168.5.1.2.1", more: str = "") -> str:
    """Return an EAP device."""
    address = "<AddressInfo><Pnp><DeviceData>020000000501</DeviceData></Pnp></AddressInfo>"
    own = f'AmsNetId="{net_id}"' if net_id else ""
    return (
        f'<Device Id="1" DevType="112" AmsPort="28673" {own} {more}><Name>{name}</Name>{address}'
        f'{"".join(boxes)}<Eap EapDeviceGuid="{{0}}"/></Device>'
    )


def project(
    *devices: str,
    types: str = "",
    target: str = 'TargetNetId="192.168.5.1.1.1"',
    tasks: Iterable[tuple[str, int]] = (("PlcTask", 10_000),),
    plc: str = "",
    mappings: str = "",
) -> str:
    """Return a project; *tasks* have names and cycles in microseconds."""
    listed = "".join(
        f'<Task Id="{n}" CycleTime="{cycle_us * 10}"><Name>{name}</Name></Task>'
        for n, (name, cycle_us) in enumerate(tasks, 3)
    )
    return (
        f'<TcSmProject TcVersion="3.1.4024.12"><DataTypes>{types}</DataTypes><Project {target}>'
        f"<System><Tasks>{listed}</Tasks></System><Plc>{plc}</Plc><Io>{''.join(devices)}</Io>"
        f"</Project><Mappings>{mappings}</Mappings></TcSmProject>"
    )


def item(*content: str, kind: str = "CDevEthernetProtocolNvDef") -> str:
    """Return an xti file."""
    return f'<TcSmItem ClassName="{kind}" SubType="112">{"".join(content)}</TcSmItem>'


def instance(*contexts: tuple[str, int], plc: str = "Line", name: str = "Line Instance") -> str:
    """Return the PLC of a project; contexts have names and cycles in microseconds."""
    listed = "".join(
        f"<Context><Id>0</Id><Name>{task}</Name><CycleTime>{cycle_us * 1000}</CycleTime></Context>"
        for task, cycle_us in contexts
    )
    return (
        f'<Project Name="{plc}"><Instance Id="#x1"><Name>{name}</Name>'
        f"<Contexts>{listed}</Contexts></Instance></Project>"
    )


def links(box: str, *pairs: tuple[str, str], owner: str = "TIPC^Line^Line Instance") -> str:
    """Return the links of one box: symbols with their groups, and the other ends."""
    listed = "".join(f'<Link VarA="{symbol}" VarB="{end}"/>' for symbol, end in pairs)
    name = f"TIID^{DEVICE}^{box}"
    return f'<OwnerA Name="{owner}"><OwnerB Name="{name}">{listed}</OwnerB></OwnerA>'


def read(
    text: str, files: Mapping[str, str] | None = None, *, file: str = "p/Line.tsproj"
) -> tuple[TwinCatProject, ImportReport]:
    """Read a project of *text* with the other *files*, by their paths."""
    known = {file: text, **(files or {})}

    def open_file(path: str) -> Iterable[bytes]:
        if path not in known:
            raise FileNotFoundError(2, "No such file or directory")
        return [known[path].encode()]

    report = ImportReport()
    return read_project(file, open_file, report), report
