"""Application of a simulated slave, without its controller: objects, mailbox, behaviour."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple, Protocol

from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.server import MailboxServer
from devicebus.mailbox.soe_server import SoeServer
from devicebus.sim.pdo import ProcessChannel, ProcessData
from devicebus.wire.alstatus import AlState
from eap.od.abort import SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import Entry, OdObject, OdState


class FaultyDictionary(ObjectDictionary):
    """Object dictionary with faults: accesses to the objects in *aborts* fail with their code."""

    def __init__(self, objects: Iterable[OdObject] = ()) -> None:
        super().__init__(objects)
        self.aborts: dict[int, int] = {}

    def upload(self, index: int, subindex: int, state: OdState) -> bytes:
        """Return the encoded value of one entry."""
        self._check(index, subindex)
        return super().upload(index, subindex, state)

    def download(self, index: int, subindex: int, data: bytes, state: OdState) -> None:
        """Write the encoded value of one entry."""
        self._check(index, subindex)
        super().download(index, subindex, data, state)

    def upload_complete(self, index: int, first: int, state: OdState) -> bytes:
        """Return a whole object."""
        self._check(index, first)
        return super().upload_complete(index, first, state)

    def download_complete(self, index: int, first: int, data: bytes, state: OdState) -> None:
        """Write a whole object."""
        self._check(index, first)
        super().download_complete(index, first, data, state)

    def _check(self, index: int, subindex: int) -> None:
        if index in self.aborts:
            raise SdoAbortError(self.aborts[index], index, subindex, "injected fault")


_ERROR_REGISTER = 0x1001
_OD_STATES = {AlState.SAFEOP: OdState.SAFEOP, AlState.OP: OdState.OP}


class Behaviour(Protocol):
    """Behaviour of a device: its inputs as a function of outputs and time."""

    def step(self, state: AlState, now_ns: int) -> None:
        """Set the entries of the inputs; entries of the outputs are valid in OP only."""


class Device:
    """Device behind a slave state machine.

    Args:
        name: Name for messages.
        dictionary: Its objects, also without CoE.
        mailbox: None for a device without a mailbox.
        behaviour: None for a device whose inputs change by downloads only.
        has_boot: True if it supports the state BOOT.
        process_channels: Sync managers of the process data; by default 2 and 3.
        needs_sync0: True if it refuses OP without SYNC0.
        identification: Device ID for a master that requests it.
        channels: Entries of its inputs and outputs by name.
    """

    def __init__(
        self,
        name: str,
        dictionary: ObjectDictionary,
        *,
        mailbox: MailboxServer | None = None,
        behaviour: Behaviour | None = None,
        has_boot: bool = False,
        process_channels: Iterable[ProcessChannel] | None = None,
        needs_sync0: bool = False,
        identification: int = 0,
        channels: Mapping[str, tuple[int, int]] | None = None,
    ) -> None:
        self.name = name
        self.dictionary = dictionary
        self.mailbox = mailbox
        self.behaviour = behaviour
        self.has_boot = has_boot
        self.needs_sync0 = needs_sync0
        self.identification = identification
        self.channels = dict(channels or {})
        self.process_data = ProcessData(dictionary, process_channels)
        self._overrides: dict[tuple[int, int], _Override] = {}
        self.al_state = AlState.INIT
        """AL state, set by the slave's state machine."""

    def od_state(self) -> OdState:
        """Return the state whose access rights apply in the dictionary."""
        return _OD_STATES.get(self.al_state, OdState.PREOP)

    def step(self, now_ns: int) -> None:
        """Run the behaviour once; overridden entries stay unchanged."""
        if self._overrides:
            self._keep()
        if self.behaviour is not None:
            self.behaviour.step(self.al_state, now_ns)
            if self._overrides:
                self._keep()

    def override(self, index: int, subindex: int, value: object) -> None:
        """Hold an entry at *value*, whatever the device or the master writes.

        Raises:
            ValueError: the value does not fit the entry.
            SdoAbortError: the entry does not exist.
        """
        entry = self.dictionary.entry(index, subindex)
        octets = entry.kind.encode(value)
        old = self._overrides.get((index, subindex))
        before = entry.octets if old is None else old.before
        self._overrides[index, subindex] = _Override(entry, octets, before)
        self._keep()

    def release(self, index: int, subindex: int) -> bool:
        """End :meth:`override`; return false if there was none.

        The entry gets its earlier value back until the device or the master writes it.
        """
        found = self._overrides.pop((index, subindex), None)
        if found is not None:
            found.entry.octets = found.before
        return found is not None

    def report_error(self, code: int, *, axis: int = 0) -> None:
        """Send an emergency by CoE and SoE; code 0 reports the end."""
        if _ERROR_REGISTER in self.dictionary:
            self.dictionary.entry(_ERROR_REGISTER, 0).octets = bytes((code != 0,))
        servers = self.mailbox.protocols.values() if self.mailbox else ()
        for server in servers:
            if isinstance(server, CoeServer):
                server.send_emergency(code, int(code != 0))
            elif isinstance(server, SoeServer):
                server.send_emergency(code, int(code != 0), drive=axis)

    def _keep(self) -> None:
        for entry, octets, _ in self._overrides.values():
            entry.octets = octets


class _Override(NamedTuple):
    entry: Entry
    octets: bytes
    before: bytes
