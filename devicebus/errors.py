"""Errors of the device bus.

EapError
└── BusError                    an operation on a bus failed
    ├── FrameLostError          a frame did not come back, also not when sent again
    ├── WorkingCounterError     fewer slaves answered than were addressed
    ├── IdentityError           a slave is not the one that was expected
    ├── AlStatusError           a slave refused a state
    ├── StateTimeoutError       a slave did not reach a state in time
    ├── SiiError                an EEPROM cannot be read, written or understood
    ├── NoMailboxError          a slave has no mailbox, or none in its state
    ├── MailboxClosedError      a slave's mailbox is closed for now, it is being brought back
    ├── MailboxSizeError        a message does not fit a slave's mailbox
    ├── MailboxBusyError        other clients' transfers kept a slave's mailbox
    ├── MailboxTimeoutError     a slave did not answer in its mailbox
    ├── MailboxRefusedError     a slave answered with a mailbox error
    ├── MailboxProtocolError    a slave's answer breaks the protocol
    ├── SoeError                an SoE server refused
    ├── FoeError                an FoE server refused
    └── EoeError                a slave refused an Ethernet setting

A refused SDO is :class:`eap.od.abort.SdoAbortError`.
"""

from __future__ import annotations

from eap.errors import EapError


class BusError(EapError):
    """Base class of the errors of the device bus; those of several slaves have a line for each."""

    has_lines = True


class FrameLostError(BusError):
    """A frame did not come back, also not when it was sent again."""


class WorkingCounterError(BusError):
    """Fewer slaves answered a datagram than were addressed."""

    def __init__(self, message: str, *, expected: int, received: int) -> None:
        super().__init__(message)
        self.expected = expected
        self.received = received


class IdentityError(BusError):
    """A slave is not the one that was expected."""


class AlStatusError(BusError):
    """A slave refused a state; *code* is its AL status code, *state* its present state."""

    def __init__(self, message: str, *, code: int, state: int) -> None:
        super().__init__(message)
        self.code = code
        self.state = state


class StateTimeoutError(BusError):
    """A slave did not reach a state within the time the standard gives it."""


class SiiError(BusError):
    """An EEPROM cannot be read, written or understood."""


class NoMailboxError(BusError):
    """A slave has no mailbox at all, or none in its target state."""


class MailboxClosedError(BusError):
    """A slave's mailbox is closed while the slave is lost or being brought back."""


class MailboxSizeError(BusError):
    """A message does not fit a slave's mailbox; nothing was sent."""


class MailboxBusyError(BusError):
    """The transfers of other clients kept a slave's mailbox; nothing was sent."""


class MailboxTimeoutError(BusError):
    """A slave did not answer in its mailbox."""


class MailboxRefusedError(BusError):
    """A slave answered with a mailbox error; *detail* as ETG.1000.4 numbers it."""

    def __init__(self, message: str, *, detail: int) -> None:
        super().__init__(message)
        self.detail = detail


class MailboxProtocolError(BusError):
    """A slave's answer breaks the protocol; data read so far is invalid."""


class SoeError(BusError):
    """An SoE server refused; *code* as IEC 61800-7-300 numbers it."""

    def __init__(self, message: str, *, code: int) -> None:
        super().__init__(message)
        self.code = code


class FoeError(BusError):
    """An FoE server refused; *code* as ETG.1000.6 numbers it, *text* is the slave's own text."""

    def __init__(self, message: str, *, code: int, text: str = "") -> None:
        super().__init__(message)
        self.code = code
        self.text = text


class EoeError(BusError):
    """A slave refused an Ethernet setting; *result* as ETG.1000.6 numbers it."""

    def __init__(self, message: str, *, result: int) -> None:
        super().__init__(message)
        self.result = result
