from __future__ import annotations

import os
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.config.pictures import MAX_PICTURE, parse_picture, read_picture

XMLNS = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'

PNG = "data:image/png;base64,AAAA"


def reduced(inner: str) -> str:
    svg = parse_picture(f"<svg {XMLNS}>{inner}</svg>".encode()).svg
    head, tail = '<svg xmlns="http://www.w3.org/2000/svg">', "</svg>"
    assert svg.startswith(head)
    assert svg.endswith(tail)
    return svg[len(head) : -len(tail)]


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ('<rect id="a" x="1" fill="red"/>', '<rect id="a" x="1" fill="red"></rect>'),
        ('<g style="fill: red ; stroke:#000!important"/>', '<g fill="red" stroke="#000"></g>'),
        ('<rect fill="blue" style="fill:red"/>', '<rect fill="red"></rect>'),
        ("<text>a &lt;&amp;<tspan>c</tspan>d</text>", "<text>a &lt;&amp;<tspan>c</tspan>d</text>"),
        ('<use xlink:href="#a"/>', '<use href="#a"></use>'),
        ('<rect fill="url(#g)"/>', '<rect fill="url(#g)"></rect>'),
        (f'<image href="{PNG}"/>', f'<image href="{PNG}"></image>'),
        ("<!-- a comment -->", ""),
        ("<title>Press</title>", "<title>Press</title>"),
    ],
)  # fmt: skip
def test_shapes_and_their_looks_are_kept(given, kept):
    assert reduced(given) == kept


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ("<script>alert(1)</script>", ""),
        ('<script href="x.js"/>after', "after"),
        ("<g><script>x</script></g>", "<g></g>"),
        ("<style>@import url(http://x);</style>", ""),
        ("<foreignObject><p>x</p></foreignObject>", ""),
        ('<a href="javascript:alert(1)"><rect/></a>', ""),
        ('<animate attributeName="href" to="javascript:x"/><set/>', ""),
        ('<rect onclick="x()" onload="x()"/>', "<rect></rect>"),
        ('<rect class="x" data-x="1" xml:base="http://x"/>', "<rect></rect>"),
        ('<use href="http://evil/x.svg#a"/>', "<use></use>"),
        ('<use href="data:image/svg+xml;base64,AAAA"/>', "<use></use>"),
        ('<use href="data:image/png;base64,AAAA"/>', "<use></use>"),
        ('<image href="data:image/svg+xml;base64,AAAA"/>', "<image></image>"),
        ('<image href="http://evil/x.png"/>', "<image></image>"),
        ('<rect fill="url(http://evil)"/>', "<rect></rect>"),
        ('<rect fill="url(#a) url(http://evil)"/>', "<rect></rect>"),
        ('<rect fill="u\\72l(http://evil)"/>', "<rect></rect>"),
        ('<rect style="fill:url(http://evil);background:url(x)"/>', "<rect></rect>"),
        ('<x:script xmlns:x="http://www.w3.org/1999/xhtml">alert(1)</x:script>', ""),
        ('<rect id="&quot; onload=&quot;x"/>', "<rect></rect>"),
        ("<?xml-stylesheet href='http://evil'?>", ""),
    ],
)
def test_everything_that_could_run_or_load_is_left_out(given, kept):
    assert reduced(given) == kept


def test_left_out_elements_are_named():
    picture = parse_picture(f"<svg {XMLNS}><style/><g id='a'><script/></g></svg>".encode())
    assert picture.left_out == ("script", "style")
    assert picture.ids == {"a"}


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "not XML"),
        (b"<svg>", "not XML"),
        (b"<svg/>", "no SVG picture"),
        (b"<html xmlns='http://www.w3.org/1999/xhtml'/>", "no SVG picture"),
        (f"<!DOCTYPE svg [<!ENTITY a 'b'>]><svg {XMLNS}>&a;</svg>".encode(), "entities"),
        (f"<!DOCTYPE svg SYSTEM 'http://x'><svg {XMLNS}/>".encode(), ""),
        (f"<svg {XMLNS}>{'<g>' * 100}{'</g>' * 100}</svg>".encode(), "64 levels"),
        (f"<svg {XMLNS}>{'<g/>' * 20_001}</svg>".encode(), "20000 elements"),
    ],
)
def test_other_files_are_refused(data, reason):
    if not reason:  # a document type without entities is usual, and nothing is loaded
        assert parse_picture(data).svg
        return
    with pytest.raises(ValueError, match=reason):
        parse_picture(data)


def test_file_is_read_with_limits(tmp_path):
    file = tmp_path / "a.svg"
    with pytest.raises(ValueError, match="No such file"):
        read_picture(file)
    file.write_bytes(b"x" * (MAX_PICTURE + 1))
    with pytest.raises(ValueError, match="more than 1 MiB"):
        read_picture(file)
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(ValueError, match="no regular file"):
        read_picture(file)


@given(
    st.lists(
        st.sampled_from(
            ["<g>", "</g>", "<script>", "</script>", "<a href='javascript:x'>", "</a>", "x", "&lt;",
             "<rect onload='x' style='fill:url(http://e)'/>", "<text id='t'>", "</text>", "<!--",
             "-->",             "<![CDATA[<script>]]>", "<svg onload='x'/>"]
        )
    )
)  # fmt: skip
def test_result_never_has_a_script_an_event_or_a_link(parts):
    try:
        svg = parse_picture(f"<svg {XMLNS}>{''.join(parts)}</svg>".encode()).svg
    except ValueError:
        return
    tags = re.findall(r"<[^>]*>", svg)
    assert not [tag for tag in tags if re.search(r"script|onload|javascript|http://e|<a", tag)]
    assert parse_picture(svg.encode()).svg == svg
