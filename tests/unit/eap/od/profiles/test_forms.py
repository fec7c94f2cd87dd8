from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.od.profiles.forms import Form, from_text, to_text


@pytest.mark.parametrize(
    ("form", "kind", "octets", "text"),
    [
        (Form.PLAIN, "UINT", b"\x39\x30", "12345"),
        (Form.PLAIN, "BOOL", b"\1", "true"),
        (Form.PLAIN, "STRING(9)", b"level", "level"),
        (Form.PLAIN, "UINT[2]", b"\1\0\2\0", "1, 2"),
        (Form.PLAIN, "BLOCK(3)", b"\xab\0\1", "ab 00 01"),
        (Form.HEX, "UDINT", b"\x89\x13\xe8\x03", "0x03E81389"),
        (Form.INDEX, "UINT", b"\x00\x1a", "0x1A00"),
        (Form.INDEX, "UINT", b"\0\0", "0x0000"),
        (Form.MAPPING, "UDINT", b"\x10\x01\x00\x60", "0x6000:01/16"),
        (Form.MAC, "BLOCK(6)", b"\1\1\5\4\0\0", "01:01:05:04:00:00"),
        (Form.NET_ID, "BLOCK(6)", b"\1\2\3\4\5\6", "1.2.3.4.5.6"),
        (Form.IP, "BLOCK(4)", b"\x0a\0\0\1", "10.0.0.1"),
    ],
)
def test_octets_and_text_are_the_same(form, kind, octets, text):
    parsed = datatypes.parse(kind)
    assert to_text(form, parsed, octets) == text
    assert from_text(form, parsed, text) == octets


@given(st.sampled_from(list(Form)), st.binary(min_size=6, max_size=6))
def test_any_octets_have_a_text_that_reads_back(form, octets):
    size = {Form.IP: "BLOCK(4)", Form.MAC: "BLOCK(6)", Form.NET_ID: "BLOCK(6)"}
    kind = datatypes.parse(size.get(form, "UDINT"))
    data = octets[: kind.size]
    assert from_text(form, kind, to_text(form, kind, data)) == data


@pytest.mark.parametrize(
    ("form", "kind", "text"),
    [
        (Form.PLAIN, "UINT", "65536"),
        (Form.INDEX, "UINT", "none"),
        (Form.MAPPING, "UDINT", "6000/16"),
        (Form.MAPPING, "UDINT", "6000:zz/16"),
        (Form.MAPPING, "UDINT", "6000:01/256"),
        (Form.MAC, "BLOCK(6)", "1.2.3.4"),
        (Form.NET_ID, "BLOCK(6)", "1.2.3.4"),
        (Form.IP, "BLOCK(4)", "1.2.3.400"),
    ],
)
def test_what_has_not_the_form_is_refused(form, kind, text):
    with pytest.raises(ValueError, match=text.split(":", maxsplit=1)[0][:3]):
        from_text(form, datatypes.parse(kind), text)


def test_numbers_may_be_typed_in_other_ways():
    assert from_text(Form.INDEX, datatypes.parse("UINT"), "26") == b"\x1a\0"
    assert from_text(Form.MAPPING, datatypes.parse("UDINT"), "0x60000110") == b"\x10\x01\0\x60"
