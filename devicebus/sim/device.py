"""What a simulated slave is apart from its controller: objects, mailbox, behaviour."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple, Protocol

from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.server import MailboxServer
from devicebus.mailbox.soe_server import SoeServer
from devicebus.sim.pdo import ProcessData
from devicebus.wire.alstatus import AlState
from eap.od.abort import SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import Entry, OdObject, OdState


class FaultyDictionary(ObjectDictionary):
    """Refuses every access to the objects in *aborts* with the code beside them."""

    def __init__(self, objects: Iterable[OdObject] = ()) -> None:
        super().__init__(objects)
        self.aborts: dict[int, int] = {}

    def upload(self, index: int, subindex: int, state: OdState) -> bytes:
        """Return the bytes of one entry."""
        self._check(index, subindex)
        return super().upload(index, subindex, state)

    def download(self, index: int, subindex: int, data: bytes, state: OdState) -> None:
        """Write the bytes of one entry."""
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
            raise SdoAbortError(self.aborts[index], index, subindex, "a fault was asked for")


_ERROR_REGISTER = 0x1001
_OD_STATES = {AlState.SAFEOP: OdState.SAFEOP, AlState.OP: OdState.OP}


class Behaviour(Protocol):
    """What a device does with its outputs and where its inputs come from."""

    def step(self, state: AlState, now_ns: int) -> None:
        """Look at the outputs' entries and set those of the inputs; outputs count in OP only."""


class Device:
    """A device as its slave state machine sees it.

    Args:
        name: For people.
        dictionary: Its objects, whether a master can read them or not.
        mailbox: None for one without a mailbox.
        behaviour: None for one whose inputs change by downloads only.
        has_boot: Whether it knows the state BOOT.
        output_channel, input_channel: Sync managers of the process data.
        needs_sync0: Whether it refuses OP without SYNC0.
        identification: What a master gets that asks for the device's ID.
        channels: The entries of its inputs and outputs by name.
    """

    def __init__(
        self,
        name: str,
        dictionary: ObjectDictionary,
        *,
        mailbox: MailboxServer | None = None,
        behaviour: Behaviour | None = None,
        has_boot: bool = False,
        output_channel: int = 2,
        input_channel: int = 3,
        needs_sync0: bool = False,
        identification: int = 0,
        channels: Mapping[str, tuple[int, int]] | None = None,
    ) -> None:
        self.name = name
        self.dictionary = dictionary
        self.mailbox = mailbox
        self.behaviour = behaviour
        self.has_boot = has_boot
        self.output_channel = output_channel
        self.input_channel = input_channel
        self.needs_sync0 = needs_sync0
        self.identification = identification
        self.channels = dict(channels or {})
        self.process_data = ProcessData(dictionary)
        self._overrides: dict[tuple[int, int], _Override] = {}
        self.al_state = AlState.INIT
        """Kept by the slave's state machine."""

    def od_state(self) -> OdState:
        """Return the state whose rights count in the dictionary."""
        return _OD_STATES.get(self.al_state, OdState.PREOP)

    def step(self, now_ns: int) -> None:
        """Let the device act once; what is overridden stays as it is."""
        if self._overrides:
            self._keep()
        if self.behaviour is not None:
            self.behaviour.step(self.al_state, now_ns)
            if self._overrides:
                self._keep()

    def override(self, index: int, subindex: int, value: object) -> None:
        """Let an entry keep *value*, whatever the device or the master puts there.

        Raises:
            ValueError: it is no value of that entry.
            SdoAbortError: there is no such entry.
        """
        entry = self.dictionary.entry(index, subindex)
        octets = entry.kind.encode(value)
        old = self._overrides.get((index, subindex))
        before = entry.octets if old is None else old.before
        self._overrides[index, subindex] = _Override(entry, octets, before)
        self._keep()

    def release(self, index: int, subindex: int) -> bool:
        """End :meth:`override`; return whether there was one.

        The entry has the value from before until device or master puts another one there.
        """
        found = self._overrides.pop((index, subindex), None)
        if found is not None:
            found.entry.octets = found.before
        return found is not None

    def report_error(self, code: int, *, axis: int = 0) -> None:
        """Send an emergency by each protocol that has them; code 0 says that it is over."""
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
