from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ads.operation import AdsRefusedError
from eap.ads.symbols import SymbolTable, SymbolVariable
from eap.codec import datatypes
from eap.codec.adssymbol import UploadInfo


def test_case_of_names_matters_only_between_two_that_differ_in_it() -> None:
    kind = datatypes.parse("USINT")
    table = SymbolTable([SymbolVariable(name, kind) for name in ("Pump", "valve", "Valve")], 0)
    assert table.handle_of("PUMP") == table.handle_of("Pump")
    assert table.handle_of("valve") != table.handle_of("Valve")
    with pytest.raises(AdsRefusedError, match="SYMBOL_NOT_FOUND"):
        table.handle_of("VALVE")


def test_table_without_symbols() -> None:
    table = SymbolTable([], 3)
    assert table.info == UploadInfo(0, 0)
    assert (table.upload, table.type_upload) == (b"", b"")
    with pytest.raises(AdsRefusedError, match="INDEX_OFFSET"):
        table.at(0)


KINDS = st.sampled_from(["BOOL", "INT24", "STRING(9)", "REAL[3]", "BLOCK(5)", "ULINT"])


@given(st.lists(KINDS, max_size=20), st.integers(0, 400))
def test_every_offset_belongs_to_one_symbol_or_none(kinds: list[str], offset: int) -> None:
    table = SymbolTable(
        [SymbolVariable(f"v{n}", datatypes.parse(kind)) for n, kind in enumerate(kinds)], 0
    )
    places = [table.by_handle(n + 1).address for n in range(len(kinds))]
    owners = [p for p in places if p.offset <= offset < p.offset + p.size]
    assert len(owners) <= 1
    try:
        symbol, start = table.at(offset)
    except AdsRefusedError:
        assert not owners
    else:
        assert owners == [symbol.address]
        assert start == offset - symbol.address.offset
