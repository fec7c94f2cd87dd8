"""SVG pictures of pages, reduced to shapes, texts and their looks.

A picture becomes part of a page, so nothing in it may run, load or link: elements and attributes
that are not listed here are left out.  The page's content security policy forbids styles in
elements; ``style`` attributes become presentation attributes, which look the same.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

MAX_PICTURE = 1 << 20
"""Bytes of the largest picture."""
_MAX_DEPTH = 64
_MAX_ELEMENTS = 20_000
_SVG = "{http://www.w3.org/2000/svg}"
_HREF = "{http://www.w3.org/1999/xlink}href"


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_ELEMENTS = _words(
    "svg g defs symbol use title desc path rect circle ellipse line polyline polygon text tspan"
    " textPath linearGradient radialGradient stop clipPath mask pattern marker image"
)
_LOOKS = _words(
    "alignment-baseline baseline-shift clip-path clip-rule color direction display"
    " dominant-baseline fill fill-opacity fill-rule font-family font-size font-stretch font-style"
    " font-variant font-weight letter-spacing marker-end marker-mid marker-start mask opacity"
    " overflow paint-order pointer-events shape-rendering stop-color stop-opacity stroke"
    " stroke-dasharray stroke-dashoffset stroke-linecap stroke-linejoin stroke-miterlimit"
    " stroke-opacity stroke-width text-anchor text-decoration text-rendering vector-effect"
    " visibility word-spacing writing-mode"
)
_ATTRIBUTES = _LOOKS | _words(
    "id viewBox preserveAspectRatio width height x y x1 y1 x2 y2 cx cy r rx ry fx fy d points"
    " transform dx dy rotate textLength lengthAdjust startOffset pathLength offset gradientUnits"
    " gradientTransform spreadMethod clipPathUnits maskUnits maskContentUnits patternUnits"
    " patternContentUnits patternTransform markerUnits markerWidth markerHeight refX refY"
    " orient role aria-label"
)
_INNER_URL = re.compile(r"url\(\s*['\"]?#[^)'\"]*['\"]?\s*\)")
_IMAGE = re.compile(r"data:image/(png|jpeg);base64,[A-Za-z0-9+/=\s]*")
_ID = re.compile(r"[^\s\"'<>&]+")


class Picture(NamedTuple):
    """Picture without anything that could run."""

    svg: str
    ids: frozenset[str]
    """Of its elements."""
    left_out: tuple[str, ...]
    """Elements that a page does not show, such as ``script``."""


def read_picture(path: Path) -> Picture:
    """Read and reduce the picture at *path*; raise ValueError if it is none."""
    try:
        if path.exists() and not path.is_file():
            raise ValueError("no regular file")
        with path.open("rb") as file:
            data = file.read(MAX_PICTURE + 1)
    except OSError as exc:
        raise ValueError(str(exc.strerror)) from None
    if len(data) > MAX_PICTURE:
        raise ValueError(f"more than {MAX_PICTURE >> 20} MiB")
    return parse_picture(data)


def parse_picture(data: bytes) -> Picture:
    """Reduce a picture; raise ValueError if *data* is none."""
    from defusedxml.common import DefusedXmlException  # only plants with a picture need it
    from defusedxml.ElementTree import fromstring

    try:
        root = fromstring(data)
    except DefusedXmlException:
        raise ValueError("it declares entities") from None
    except (SyntaxError, ValueError, LookupError) as exc:
        raise ValueError(f"not XML that can be read: {exc}") from None
    if root.tag != f"{_SVG}svg":
        raise ValueError("no SVG picture (its root is not svg in the namespace of SVG)")
    ids: set[str] = set()
    left_out: set[str] = set()
    svg = "".join(_write(root, ids, left_out))
    return Picture(svg, frozenset(ids), tuple(sorted(left_out)))


def _write(root: Element, ids: set[str], left_out: set[str]) -> Iterator[str]:
    """Yield the text of what is allowed, without recursion."""
    stack: list[tuple[Element, Iterator[Element], str]] = []
    number = 0
    pending: Element | None = root
    while pending is not None or stack:
        if pending is not None:
            number += 1
            if number > _MAX_ELEMENTS or len(stack) > _MAX_DEPTH:
                raise ValueError(f"more than {_MAX_ELEMENTS} elements, or {_MAX_DEPTH} levels")
            name = str(pending.tag).removeprefix(_SVG)
            xmlns = "" if stack else ' xmlns="http://www.w3.org/2000/svg"'
            yield f"<{name}{xmlns}{''.join(_attributes(pending, ids))}>"
            yield _escape(pending.text)
            stack.append((pending, iter(pending), name))
            pending = None
        element, children, name = stack[-1]
        for child in children:
            tag = child.tag if isinstance(child.tag, str) else ""
            if tag.startswith(_SVG) and tag.removeprefix(_SVG) in _ELEMENTS:
                pending = child
                break
            if tag.startswith(_SVG):
                left_out.add(tag.removeprefix(_SVG))
            yield _escape(child.tail)
        if pending is None:
            stack.pop()
            yield f"</{name}>"
            if stack:
                yield _escape(element.tail)


def _attributes(element: Element, ids: set[str]) -> Iterator[str]:
    given = {str(name): str(value) for name, value in element.attrib.items()}
    kept = {name: value for name, value in given.items() if name in _ATTRIBUTES}
    # A style has precedence over the attribute of the same name.
    for declaration in given.get("style", "").split(";"):
        name, _, value = declaration.partition(":")
        if name.strip() in _LOOKS:
            kept[name.strip()] = value.replace("!important", "").strip()
    if (number := kept.get("id")) is not None:
        if _ID.fullmatch(number):
            ids.add(number)
        else:
            del kept["id"]
    target = given.get("href", given.get(_HREF, "")).strip()
    if target.startswith("#") or (
        element.tag == f"{_SVG}image" and _IMAGE.fullmatch(target) is not None
    ):
        kept["href"] = target
    for name, value in kept.items():
        if name == "href" or _is_inner(value):
            yield f' {name}="{_escape(value)}"'


def _is_inner(value: str) -> bool:
    """Return whether a value refers to nothing outside the picture."""
    rest = _INNER_URL.sub("", value).lower()
    return "url" not in rest and "\\" not in rest and "javascript" not in rest


def _escape(text: str | None) -> str:
    if not text:
        return ""
    return (
        text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace('"', "&quot;")
    )
