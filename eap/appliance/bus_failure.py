"""Errors of a bus on their way between processes: a name, a text and one number."""

from __future__ import annotations

from devicebus import errors
from devicebus.errors import BusError, NoMailboxError
from eap.appliance.bus_request import Failure, SlaveDescription
from eap.errors import EapError

_SHIFT = 16
_MASK = 0xFFFF
_CODED = {
    "MailboxRefusedError": "detail",
    "SoeError": "code",
    "FoeError": "code",
    "EoeError": "result",
}


def to_failure(error: EapError) -> Failure:
    """Return what another process is told; one that is no BusError arrives as BusError."""
    kind = type(error).__name__
    if getattr(errors, kind, None) is not type(error):
        return Failure("BusError", str(error))
    return Failure(kind, str(error), _detail(error))


def to_error(failure: Failure) -> BusError:
    """Return the error that *failure* tells of, with its text and its numbers as they were."""
    kind = getattr(errors, failure.kind, BusError)
    if not (isinstance(kind, type) and issubclass(kind, BusError)):
        kind = BusError
    # The constructors make texts of numbers; here the text is there already.
    error: BusError = kind.__new__(kind, failure.message)
    high, low = failure.detail >> _SHIFT, failure.detail & _MASK
    if isinstance(error, errors.WorkingCounterError):
        error.expected, error.received = high, low
    elif isinstance(error, errors.AlStatusError):
        error.state, error.code = high, low
    elif failure.kind in _CODED:
        setattr(error, _CODED[failure.kind], failure.detail)
    if isinstance(error, errors.FoeError):
        error.text = ""
    return error


def no_mailbox(slave: SlaveDescription) -> BusError:
    """Return why no mailbox of a slave is open, as its master says."""
    if slave.mailbox_fault is not None:
        return to_error(slave.mailbox_fault)
    return NoMailboxError(f"slave {slave.station} ({slave.name}) has no open mailbox")


def _detail(error: EapError) -> int:
    if isinstance(error, errors.WorkingCounterError):
        return error.expected << _SHIFT | error.received
    if isinstance(error, errors.AlStatusError):
        return error.state << _SHIFT | error.code
    kind = type(error).__name__
    return int(getattr(error, _CODED[kind])) if kind in _CODED else 0
