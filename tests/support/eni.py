"""ENI files of the tests' own making, with the structure of published ones."""

from __future__ import annotations


def config(*slaves: str, cyclic: str = "", image: str = "", head: str = "") -> str:
    """Return a file with *slaves*."""
    info = "<Master><Info><Name><![CDATA[Device 1 (EtherCAT)]]></Name></Info></Master>"
    return (
        f'{head}<EtherCATConfig Version="1.3"><Config>\n{info}\n'
        + "\n".join(slaves)
        + f"\n{cyclic}<ProcessImage>{image}</ProcessImage></Config></EtherCATConfig>"
    )


def slave(name: str, number: int, *parts: str, product: str = "4660", info: str = "") -> str:
    """Return the slave with station address 1000 + *number*."""
    return (
        f"<Slave><Info><Name><![CDATA[{name}]]></Name><PhysAddr>{1000 + number}</PhysAddr>"
        f"<VendorId>3674</VendorId><ProductCode>{product}</ProductCode>"
        f"<RevisionNo>65536</RevisionNo>{info}</Info>\n" + "\n".join(parts) + "</Slave>"
    )


def register(ado: int, data: str, at: str = "PS", more: str = "", cmd: int = 5) -> str:
    """Return a command that writes a register."""
    return (
        f"<InitCmd><Transition>{at}</Transition><Cmd>{cmd}</Cmd><Adp>1001</Adp><Ado>{ado}</Ado>"
        f"<Data>{data}</Data><Cnt>1</Cnt>{more}</InitCmd>"
    )


def commands(*inner: str) -> str:
    """Return the register commands of a slave."""
    return f"<InitCmds>{''.join(inner)}</InitCmds>"


def sdo(index: str, sub: int, data: str, at: str = "PS", ccs: int = 1, more: str = "") -> str:
    """Return a start-up command by CoE."""
    key = ' CompleteAccess="1"' if "complete" in more else ""
    text = more.replace("complete", "")
    transitions = "".join(f"<Transition>{each}</Transition>" for each in at.split())
    return (
        f"\n<InitCmd{key}>{transitions}<Ccs>{ccs}</Ccs><Index>{index}</Index>"
        f"<SubIndex>{sub}</SubIndex><Data>{data}</Data>{text}</InitCmd>"
    )


def idn(number: int, data: str, *, drive: int = 0, more: str = "") -> str:
    """Return a start-up command by SoE."""
    return (
        f"<InitCmd><Transition>PS</Transition><OpCode>3</OpCode><DriveNo>{drive}</DriveNo>"
        f"<IDN>{number}</IDN><Elements>64</Elements><Attribute>0</Attribute><Data>{data}</Data>"
        f"{more}</InitCmd>"
    )


def mailbox(coe: str = "", soe: str = "", receive: str = "Recv") -> str:
    """Return the mailbox of a slave."""
    protocols = "".join(
        f"<Protocol>{name}</Protocol><{name}><InitCmds>{inner}</InitCmds></{name}>"
        for name, inner in (("CoE", coe), ("SoE", soe))
        if inner
    )
    return (
        "<Mailbox><Send><Start>4096</Start><Length>128</Length></Send>"
        f"<{receive}><Start>4224</Start><Length>128</Length></{receive}>{protocols}</Mailbox>"
    )


def manager(number: int, kind: str, start: int, control: int, *pdos: int) -> str:
    """Return a sync manager of ProcessData."""
    listed = "".join(f"<Pdo>{each}</Pdo>" for each in pdos)
    return (
        f"<Sm{number}><Type>{kind}</Type><StartAddress>{start}</StartAddress>"
        f"<ControlByte>{control}</ControlByte><Enable>1</Enable>{listed}</Sm{number}>"
    )


def pdo(tag: str, index: str, name: str, *entries: tuple[str, int, int, str, str]) -> str:
    """Return a PDO with entries: index, subindex, bits, name, type."""
    inner = "".join(
        f"<Entry><Index>{number}</Index><SubIndex>{sub}</SubIndex><BitLen>{bits}</BitLen>"
        f"<Name>{label}</Name><DataType>{kind}</DataType></Entry>"
        for number, sub, bits, label, kind in entries
    )
    return f"<{tag}><Index>{index}</Index><Name>{name}</Name>{inner}</{tag}>"


def process_data(*inner: str, send: int = 0, recv: int = 0) -> str:
    """Return the process data of a slave, *send* bits of outputs and *recv* of inputs."""
    sides = "".join(
        f"<{tag}><BitStart>16</BitStart><BitLength>{bits}</BitLength></{tag}>"
        for tag, bits in (("Send", send), ("Recv", recv))
        if bits
    )
    return f"<ProcessData>{sides}{''.join(inner)}</ProcessData>"


def variable(name: str, kind: str, bits: int, offset: int) -> str:
    """Return a variable of the process image."""
    return (
        f"<Variable><Name>{name}</Name><DataType>{kind}</DataType><BitSize>{bits}</BitSize>"
        f"<BitOffs>{offset}</BitOffs></Variable>"
    )
