from __future__ import annotations

import inspect
import re

import pytest

from eap import errors
from eap.errors import CodecError, ControlError, EapError, TornReadError, WriterConflictError

TREE = [error for _, error in inspect.getmembers(errors, inspect.isclass) if error is not EapError]


@pytest.mark.parametrize("error", TREE, ids=lambda error: error.__name__)
def test_every_error_hangs_in_the_tree_as_drawn(error: type[EapError]) -> None:
    assert issubclass(error, EapError)
    assert errors.__doc__ is not None
    drawn = {
        match[2]: len(match[1]) for match in re.finditer(r"(?m)^(.*?)(\w+Error)\b", errors.__doc__)
    }
    lines = list(drawn)
    parent = next(
        name
        for name in reversed(lines[: lines.index(error.__name__)])
        if drawn[name] < drawn[error.__name__]
    )
    assert error.__bases__[0].__name__ == parent


def test_codec_error_says_layout_and_offset() -> None:
    error = CodecError("ends early", layout="PdHeader", offset=14)
    assert str(error) == "PdHeader at offset 14: ends early"
    assert (error.layout, error.offset) == ("PdHeader", 14)
    assert isinstance(error, ValueError)


def test_facts_are_attributes() -> None:
    assert TornReadError("stopped", writer="engine").writer == "engine"
    assert WriterConflictError("taken", holder="pid 7").holder == "pid 7"
    assert ControlError("no").code == "refused"
    assert ControlError("no", code="unknown").code == "unknown"
