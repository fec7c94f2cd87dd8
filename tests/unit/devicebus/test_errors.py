from __future__ import annotations

from devicebus import errors
from devicebus.errors import BusError, WorkingCounterError
from devicebus.master.procedure import not_answered
from devicebus.wire.datagram import DatagramReply
from eap.errors import EapError


def test_docstring_draws_every_error() -> None:
    drawn = errors.__doc__ or ""
    for name, value in vars(errors).items():
        if isinstance(value, type) and issubclass(value, BusError):
            assert name in drawn
            assert issubclass(value, EapError)


def test_working_counter_tells_both_numbers() -> None:
    error = not_answered("slave 1001, AL status", DatagramReply(b"", 0))
    assert isinstance(error, WorkingCounterError)
    assert str(error) == "slave 1001, AL status: working counter 0, expected 1"
    assert (error.expected, error.received) == (1, 0)
