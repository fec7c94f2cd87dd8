"""The control protocol on paper."""

from __future__ import annotations

from contextlib import suppress

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from eap.control import protocol as control
from eap.control.protocol import (
    ControlReply,
    ErrorCode,
    Failure,
    Request,
    of_station,
    unless_unavailable,
)
from eap.errors import ControlError, EnvironmentalError


def test_a_request_crosses():
    line = control.encode_request(4, "read", {"station": "a"})
    assert line == b'{"v":1,"id":4,"method":"read","params":{"station":"a"}}\n'
    assert control.decode_request(line) == Request(1, "read", 4, {"station": "a"})


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b"", ErrorCode.BAD_REQUEST),
        (b"\xff\n", ErrorCode.BAD_REQUEST),
        (b"[]\n", ErrorCode.BAD_REQUEST),
        (b'{"method":"hello"}\n', ErrorCode.BAD_REQUEST),
        (b'{"v":1,"id":"x","method":"hello"}\n', ErrorCode.BAD_REQUEST),
        (b'{"v":1,"method":"hello","params":[]}\n', ErrorCode.BAD_REQUEST),
        (b'{"v":2,"id":1,"method":"hello"}\n', ErrorCode.VERSION),
    ],
)
def test_decode_request_malformed_line_has_an_error_code(line, code):
    with pytest.raises(ControlError) as caught:
        control.decode_request(line)
    assert caught.value.code == code


@given(st.binary(max_size=64))
@example(b'{"v":1,"id":1,"method":"\xff"}')
@example(b'{"v":1,"id":1,"other":' + b"[" * 100_000)
def test_garbage_never_escapes(noise):
    control.request_id(noise)
    with suppress(ControlError):
        control.decode_request(noise)
    with suppress(ControlError):
        control.decode_reply(noise)


def test_the_id_of_a_refused_line_is_found():
    assert control.request_id(b'{"v":9,"id":3}') == 3
    assert control.request_id(b'{"v":9}') is None
    assert control.request_id(b'{"id":"3"}') is None
    assert control.request_id(b"[1]") is None


def test_answers_cross():
    assert control.decode_reply(control.encode_result(1, {"a": 1})) == ControlReply(1, 1, {"a": 1})
    refused = control.encode_error(2, ControlError("no", code=ErrorCode.REFUSED))
    assert control.decode_reply(refused) == ControlReply(1, 2, error=Failure("refused", "no"))
    event = control.encode_event(3, {"cycle": 5})
    assert control.decode_reply(event) == ControlReply(1, subscription=3, event={"cycle": 5})


def test_an_answer_too_long_becomes_an_error():
    reply = control.decode_reply(control.encode_result(1, "x" * control.MAX_LINE))
    assert reply.error is not None
    assert reply.error.code == ErrorCode.BUSY


def test_unknown_parameters_are_refused():
    with pytest.raises(msgspec.ValidationError, match="nmaes"):
        msgspec.convert({"station": "a", "nmaes": []}, control.ReadParameters)


def test_a_station_that_is_not_here_is_refused_with_the_nearest_name():
    assert of_station("left", {"left": 1}) == 1
    with pytest.raises(ControlError, match="unknown station 'lefd', did you mean left") as caught:
        of_station("lefd", {"left": 1})
    assert caught.value.code is ErrorCode.UNKNOWN_NAME


def test_unless_unavailable_converts_environmental_errors():
    with pytest.raises(ControlError, match="disk full") as caught, unless_unavailable():
        raise EnvironmentalError("disk full")
    assert caught.value.code is ErrorCode.UNAVAILABLE


def test_a_line_nested_too_deep_is_refused():
    line = b'{"v": 1, "id": 3, "method": "read", "params": {"a": ' + b"[" * 100_000
    with pytest.raises(ControlError, match="nested too deep"):
        control.decode_request(line)
    assert control.request_id(line) is None
