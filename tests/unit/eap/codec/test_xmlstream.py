from __future__ import annotations

from contextlib import suppress
from itertools import chain, repeat

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.xmlstream import (
    CHUNK,
    XmlError,
    XmlLimits,
    XmlReader,
    parse_integer,
    read_tree,
)

FILE = """\
<?xml version="1.0" encoding="utf-8"?>
<Info xmlns:x="http://x" x:schema="y" Version=" 1 ">
  <Vendor><Id>#x2</Id></Vendor>
  <Devices>
    <Device Code="#x10"><Name><![CDATA[ Out & in ]]></Name><Picture>00</Picture><On>1</On></Device>
    <Other><Device/></Other>
    <Device><Name>µ</Name><Number>
      - 12 </Number></Device>
  </Devices>
</Info>
"""
DEVICES = "Info/Devices/Device"


def refusal(*chunks: bytes | str, limits: XmlLimits | None = None) -> XmlError:
    with pytest.raises(XmlError) as caught:
        read_tree(chunks, roots=("a",), limits=limits or XmlLimits())
    return caught.value


def test_reader_returns_wanted_elements_with_their_lines() -> None:
    first, second = XmlReader([DEVICES], roots=["Info"], ignored=["Picture"]).read([FILE])
    assert [each.tag for each in first.children] == ["Name", "On"]
    assert (first.line, second.line) == (5, 7)
    assert first.findtext("Name") == "Out & in"
    assert first.attribute_number("Code", 0, 255) == 16
    assert first.flag_at("On")
    assert not first.flag_at("Off")
    assert second.findtext("Name") == "µ"
    assert second.number_at("Number", -20, 20) == -12
    assert second.findtext("Nothing", "else") == "else"


def test_reader_returns_each_element_in_the_part_that_ends_it() -> None:
    reader = XmlReader([DEVICES, "Info/Vendor"])
    assert [each.tag for each in reader.feed(FILE[: FILE.index("<Other>")])] == ["Vendor", "Device"]
    assert reader.root is not None
    assert reader.root.get("Version") == "1"
    assert reader.root.get("schema") == "y"
    assert not reader.root.children
    assert [each.tag for each in reader.feed(FILE[FILE.index("<Other>") :])] == ["Device"]
    assert reader.close() == []
    devices = reader.above("Info/Devices")
    assert devices is not None
    assert devices.line == 4
    assert reader.above(DEVICES) is None


def test_tree_is_searched_by_path() -> None:
    root = read_tree([FILE.encode()])
    assert [each.line for each in root.iterfind("Devices/Device")] == [5, 7]
    assert root.findtext("Vendor/Id") == "#x2"
    assert root.find("Devices/None/Device") is None


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "iso-8859-1", "windows-1252"])
def test_reader_takes_encodings_in_single_bytes(encoding: str) -> None:
    name = encoding.removesuffix("-sig")
    octets = FILE.replace('encoding="utf-8"', f'encoding="{name}"').encode(encoding)
    parts = [octets[at : at + 1] for at in range(len(octets))]
    assert [each.findtext("Name") for each in XmlReader([DEVICES]).read(parts)] == ["Out & in", "µ"]


def test_reader_replaces_bytes_of_another_encoding() -> None:
    assert read_tree([b"<a>10 \xb5s</a>"]).text == "10 \N{REPLACEMENT CHARACTER}s"


def test_reader_takes_utf8_that_is_declared_as_utf16() -> None:
    # StringWriter of .NET declares UTF-16 whatever the file is saved in.
    assert read_tree([b'<?xml version="1.0" encoding="utf-16"?><a>x</a>']).text == "x"


@pytest.mark.parametrize("name", ["none", "zlib", "iso-8859-99", "utf-7"])
def test_reader_refuses_unknown_encodings(name: str) -> None:
    error = refusal(f'<?xml version="1.0" encoding="{name}"?><a/>'.encode())
    assert f"its encoding is '{name}'" in str(error)
    assert error.line == 1


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("", 1, "no element found"),
        ("<a>\n<b>", 2, "no element found"),
        ("<a>\n<b></a>", 2, "mismatched tag"),
        ("<a>\n<b x='1' x='2'/></a>", 2, "duplicate attribute"),
        ("\n<b/>", 2, "it begins with 'b'"),
        ('<!DOCTYPE a [<!ENTITY x "y">]><a>&x;</a>', 0, "declares entities or a document type"),
        ('<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', 0, "declares entities or a document"),
        ("<a>&x;</a>", 1, "undefined entity"),
        ("<a>\ud800</a>", 0, "not XML that can be read"),
        ("<a>" * 65, 1, "nested too deeply"),
    ],
)
def test_hostile_and_broken_files_are_refused_with_their_line(
    text: str, line: int, reason: str
) -> None:
    error = refusal(text)
    assert reason in str(error)
    assert error.line == line


def test_limits_are_kept() -> None:
    assert "too many elements" in str(refusal("<a>" + "<b/>" * 9, limits=XmlLimits(elements=8)))
    long_text = refusal("<a><b>" + "x" * 90, "</b></a>", limits=XmlLimits(text=80))
    assert "the text of b is too long" in str(long_text)
    assert "more than 1 MiB" in str(refusal("<a>", "x" * (1 << 20), limits=XmlLimits(size=1 << 20)))


@pytest.mark.parametrize("start", ["<a><b c='", "<a><b", "<a><!--", "<a><![CDATA[", "<a><?x "])
def test_token_without_end_is_refused_before_the_file_ends(start: str) -> None:
    endless = chain([start], repeat("x" * CHUNK))
    with pytest.raises(XmlError, match="too long"):
        read_tree(endless, limits=XmlLimits(text=4 * CHUNK))


def test_dropped_elements_count_for_the_depth_only() -> None:
    text = "<a><skip>" + "<b>" * 10 + "</b>" * 10 + "</skip><c/></a>"
    limits = XmlLimits(elements=1, depth=12)
    assert [each.tag for each in XmlReader(["a/c"], limits=limits).read([text])] == ["c"]
    with pytest.raises(XmlError, match="nested"):
        list(XmlReader(["a/c"], limits=XmlLimits(depth=11)).read([text]))


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("12", 12),
        ("-12", -12),
        ("+7", 7),
        ("#x1A", 26),
        ("0X1a", 26),
        ("# x 1\n0", 16),
        ("", None),
        ("1.5", None),
        ("#x", None),
        ("1e5", None),
        ("9" * 21, None),
        ("٣", None),
    ],
)
def test_integers_are_read(text: str, number: int | None) -> None:
    assert parse_integer(text) == number


def test_numbers_and_flags_out_of_range_name_element_and_line() -> None:
    root = read_tree(["<a>\n<Id X='70000'>-1</Id><On>maybe</On></a>"])
    with pytest.raises(XmlError, match="Id is '-1'") as caught:
        root.number_at("Id", 0, 9)
    assert (caught.value.line, caught.value.expected) == (2, "a whole number from 0 to 9")
    with pytest.raises(XmlError, match="Id X is '70000'"):
        root.children[0].attribute_number("X", 0, 0xFFFF)
    with pytest.raises(XmlError, match="On is 'maybe'"):
        root.flag_at("On")


@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused(octets: bytes) -> None:
    with suppress(XmlError):
        read_tree([octets])
    with suppress(XmlError):
        read_tree([b"<a>", octets, b"</a>"])


@given(st.integers(0, len(FILE) - 2))
def test_truncated_file_is_refused(length: int) -> None:
    with pytest.raises(XmlError):
        read_tree([FILE[:length]])
