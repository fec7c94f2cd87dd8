"""What a simulated slave is apart from its controller: objects, mailbox, behaviour."""

from __future__ import annotations

from typing import Protocol

from devicebus.mailbox.server import MailboxServer
from devicebus.sim.pdo import ProcessData
from devicebus.wire.alstatus import AlState
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState

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
        self.process_data = ProcessData(dictionary)
        self.al_state = AlState.INIT
        """Kept by the slave's state machine."""

    def od_state(self) -> OdState:
        """Return the state whose rights count in the dictionary."""
        return _OD_STATES.get(self.al_state, OdState.PREOP)

    def step(self, now_ns: int) -> None:
        """Let the device act once."""
        if self.behaviour is not None:
            self.behaviour.step(self.al_state, now_ns)
