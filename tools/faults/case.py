"""Faults to try: the event, its duration, and the requests of clients meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from typing import Any, NamedTuple, TypeAlias

from devicebus.mailbox import foe_client
from devicebus.mailbox.coe_client import upload
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.sim.spec import FaultKind, FaultSpec
from eap.ids import ObjectId

FILE = "firmware.bin"
FILE_SIZE = 20_000


class Request(NamedTuple):
    """Request of a client to a slave during the fault."""

    what: str
    station: int
    begin: Callable[[MailboxSizes], Conversation[Any]]


Faults: TypeAlias = tuple[FaultSpec, ...]


class Case(NamedTuple):
    """One row of the table.

    Attributes:
        what: What happens, in words.
        faults: Begun together; the longest says how long all of it lasts.
        request: Started 1 ms later.
        swapped: Slave that comes back as another product.
    """

    what: str
    faults: Faults
    request: Request | None = None
    swapped: str = ""

    @property
    def kind(self) -> FaultKind:
        """By which it is called: the last one's, the others lead to it."""
        return self.faults[-1].kind

    @property
    def duration_ms(self) -> int:
        """Duration of the fault."""
        return max(fault.at_ms + (fault.for_ms or 0) for fault in self.faults)


def _read(station: int, index: int = 0x1018, subindex: int = 1) -> Request:
    what = f"read {ObjectId(index, subindex)}"
    return Request(what, station, lambda sizes: upload(index, subindex))


def _write_file(sizes: MailboxSizes) -> Conversation[int]:
    return foe_client.write(FILE, BytesIO(bytes(FILE_SIZE)).read, sizes)


_FILE = Request(f"write {FILE_SIZE // 1000} kB by FoE", 1003, _write_file)


def _one(kind: FaultKind, for_ms: int, **more: Any) -> Faults:
    return (FaultSpec(kind=kind, for_ms=for_ms, **more),)


CASES = (
    Case("every 10th frame is lost", _one(FaultKind.LOSS, 500, every=10), _read(1002)),
    Case("no frame comes back for 50 ms", _one(FaultKind.LOSS, 50), _read(1002)),
    Case("no frame comes back for 500 ms", _one(FaultKind.LOSS, 500), _read(1002)),
    Case("frames come back 1.5 ms late", _one(FaultKind.DELAY, 500, delay_us=1500), _read(1002)),
    Case("frames come back 5 ms late", _one(FaultKind.DELAY, 500, delay_us=5000), _read(1002)),
    Case(
        "every 10th frame breaks in front of `drive`",
        _one(FaultKind.CORRUPT, 500, slave="drive", every=10),
        _read(1002),
    ),
    Case("every 20th frame has wrong working counters", _one(FaultKind.WKC, 500, every=20)),
    Case("all working counters are one too small", _one(FaultKind.WKC, 500), _read(1002)),
    Case("the cable in front of `drive` is cut", _one(FaultKind.CUT, 500, slave="drive")),
    Case("the cable to the first slave is cut", _one(FaultKind.CUT, 500, slave="coupler")),
    Case("`plain` has no power", _one(FaultKind.POWER, 500, slave="plain")),
    Case("`island` has no power", _one(FaultKind.POWER, 500, slave="island"), _read(1002)),
    Case(
        "`plain` is taken out, another product is plugged in, then the right one",
        _one(FaultKind.POWER, 200, slave="plain"),
        swapped="plain",
    ),
    Case(
        "`drive` takes nothing out of its mailbox",
        _one(FaultKind.MAILBOX, 2500, slave="drive"),
        _read(1003),
    ),
    Case("`drive` takes no file", _one(FaultKind.MAILBOX, 1000, slave="drive"), _FILE),
    Case(
        "`drive` needs 20 ms for each message of a file",
        _one(FaultKind.FOE, 3000, slave="drive", delay_us=20_000),
        _FILE,
    ),
    Case(
        "`drive` aborts every access to 0x6041",
        _one(FaultKind.SDO, 100, slave="drive", object="0x6041", code=0x08000022),
        _read(1003, 0x6041, 0),
    ),
    Case(
        "`drive` sends an emergency",
        _one(FaultKind.EMERGENCY, 100, slave="drive", code=0x8611),
    ),
    Case(
        "`drive` sends an unsolicited TxPDO",
        _one(FaultKind.TX_PDO, 100, slave="drive", object="0x1A00"),
    ),
    Case(
        "`island` has no power, and then an EEPROM that does not answer for 3 s",
        (
            FaultSpec(kind=FaultKind.POWER, for_ms=200, slave="island"),
            FaultSpec(kind=FaultKind.EEPROM, at_ms=200, for_ms=3000, slave="island"),
        ),
    ),
    Case(
        "`drive` reports an error and leaves OP",
        _one(FaultKind.AL_ERROR, 1, slave="drive", code=0x001A),
    ),
    Case(
        "`island` reports an error and refuses OP for 1.5 s",
        (
            FaultSpec(kind=FaultKind.AL_ERROR, for_ms=1, slave="island", code=0x0052),
            FaultSpec(kind=FaultKind.REFUSE, for_ms=1500, slave="island", state="OP", code=0x0052),
        ),
    ),
    Case(
        "the clock of `drive` runs 200 ppm fast",
        _one(FaultKind.DRIFT, 500, slave="drive", drift_ppm=200.0),
    ),
)
