"""XML files as a stream of elements, with line numbers and limits.

Vendors' files are large (ESI files of 30 MB) and not always well made, and anybody may have written
them.  Therefore: one element of interest is in memory at a time, elements of no interest are
dropped while they are read, declarations of document types and entities are refused, and depth,
texts and numbers have limits.  Bytes that are not valid in the encoding of the file, as in comments
that a tool saved in another one, are replaced.

Namespaces are ignored: elements and attributes have their local names.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from typing import NamedTuple, NoReturn

from eap.errors import EapError

CHUNK = 1 << 16
"""Bytes that a caller reads from a file at a time."""


class XmlError(EapError, ValueError):
    """An XML file cannot be used; *line* is from 1 on, 0 for the file as a whole."""

    def __init__(self, message: str, *, line: int = 0, expected: str = "an XML file") -> None:
        super().__init__(message)
        self.line = line
        self.expected = expected


class XmlLimits(NamedTuple):
    """Limits of a file; each is refused with its number."""

    depth: int = 64
    elements: int = 1_000_000
    """Elements inside one element that is returned."""
    text: int = 4 << 20
    """Characters of the text of one element, and of one tag with its attributes."""
    size: int = 512 << 20
    """Bytes of the file."""


DEFAULT_LIMITS = XmlLimits()
# ESI files write hexadecimal numbers with #x.
_INTEGER = re.compile(r"([-+]?)(?:(#x|0x)([0-9a-f]{1,16})|([0-9]{1,20}))", re.ASCII | re.IGNORECASE)
_TRUE, _FALSE = frozenset(("1", "true")), frozenset(("0", "false", ""))


class XmlElement:
    """An element with its attributes, text, children and line.

    Paths are names between slashes, from the element on: ``find("Profile/Dictionary")``.
    """

    __slots__ = ("attrib", "children", "line", "tag", "text")

    def __init__(self, tag: str, attrib: dict[str, str], line: int) -> None:
        self.tag = tag
        self.attrib = attrib
        self.line = line
        self.text = ""
        """Without the white space around it."""
        self.children: list[XmlElement] = []

    def iterfind(self, path: str) -> Iterator[XmlElement]:
        """Yield the elements at *path* in the order of the file."""
        name, _, rest = path.partition("/")
        for child in self.children:
            if child.tag == name:
                if rest:
                    yield from child.iterfind(rest)
                else:
                    yield child

    def find(self, path: str) -> XmlElement | None:
        """Return the first element at *path*."""
        return next(self.iterfind(path), None)

    def findtext(self, path: str, default: str = "") -> str:
        """Return the text of the first element at *path*, *default* if there is none."""
        found = self.find(path)
        return default if found is None else found.text

    def get(self, name: str, default: str = "") -> str:
        """Return an attribute without the white space around it."""
        return self.attrib.get(name, default).strip()

    def number(self, low: int, high: int) -> int:
        """Return the text as a number; raise XmlError if it is none from *low* to *high*."""
        return _number(self.text, self.tag, self.line, low, high)

    def number_at(self, path: str, low: int, high: int, default: int = 0) -> int:
        """Return the number of the first element at *path*, *default* without one."""
        found = self.find(path)
        return default if found is None or not found.text else found.number(low, high)

    def attribute_number(self, name: str, low: int, high: int, default: int = 0) -> int:
        """Return an attribute as a number, *default* without one."""
        text = self.get(name)
        return _number(text, f"{self.tag} {name}", self.line, low, high) if text else default

    def flag_at(self, path: str, *, default: bool = False) -> bool:
        """Return whether the first element at *path* is true or 1."""
        found = self.find(path)
        return default if found is None else _flag(found.text, found.tag, found.line)

    def attribute_flag(self, name: str) -> bool:
        """Return whether an attribute is true or 1."""
        return _flag(self.get(name), f"{self.tag} {name}", self.line)


def _flag(text: str, what: str, line: int) -> bool:
    if text.lower() not in _TRUE | _FALSE:
        raise XmlError(f"{what} is {_shortened(text)!r}", line=line, expected="true, false, 1 or 0")
    return text.lower() in _TRUE


def _number(text: str, what: str, line: int, low: int, high: int) -> int:
    number = parse_integer(text)
    if number is None or not low <= number <= high:
        expected = f"a whole number from {low} to {high}"
        raise XmlError(f"{what} is {_shortened(text)!r}", line=line, expected=expected)
    return number


def parse_integer(text: str) -> int | None:
    """Return a number: decimal, or hexadecimal behind ``#x`` or ``0x``; None if it is none.

    Spaces and newlines inside it, which vendors' files have, are left out.
    """
    match = _INTEGER.fullmatch("".join(text.split()))
    if match is None:
        return None
    number = int(match[3], 16) if match[2] else int(match[4])
    return -number if match[1] == "-" else number


class XmlReader:
    """Reader of one file, fed with its bytes as they come.

    Args:
        wanted: Paths from the root on, such as ``EtherCATInfo/Descriptions/Devices/Device``; the
            elements there are returned complete, everything else is dropped.
        roots: Names that the root may have; any if there are none.
        ignored: Names of elements that are dropped wherever they are.
        limits: Limits of the file.
        select: Called with the tag and the attributes of a wanted element; false drops it.

    Raises:
        XmlError: (``feed`` and ``close``) the file is no such file.
    """

    def __init__(
        self,
        wanted: Collection[str],
        *,
        roots: Collection[str] = (),
        ignored: Collection[str] = (),
        limits: XmlLimits = DEFAULT_LIMITS,
        select: Callable[[XmlElement], bool] | None = None,
    ) -> None:
        from defusedxml.ElementTree import XMLParser  # most programs read no XML

        self._builder = _TreeBuilder(
            frozenset(wanted), tuple(roots), frozenset(ignored), limits, select
        )
        self._parser = XMLParser(target=self._builder, forbid_dtd=True)
        self._expat = self._builder.expat = self._parser.parser
        self._limits = limits
        self._decoder = _Decoder()
        self._received = 0
        self._parsed = 0

    @property
    def root(self) -> XmlElement | None:
        """The root without its children, as soon as its tag has been read."""
        return self._builder.root

    def above(self, path: str) -> XmlElement | None:
        """Return the last element at *path*, above those that are wanted, without children."""
        return self._builder.above.get(path)

    def feed(self, data: bytes | str) -> list[XmlElement]:
        """Take the next part of the file; return the wanted elements that end in it."""
        self._received += len(data)
        if self._received > self._limits.size:
            message = f"it has more than {self._limits.size >> 20} MiB"
            raise XmlError(message, expected=f"at most {self._limits.size >> 20} MiB")
        self._parse(data if isinstance(data, str) else self._decoder.decode(data))
        return self._builder.take()

    def close(self) -> list[XmlElement]:
        """End the file; return the wanted elements that were left."""
        self._parse(self._decoder.decode(b"", final=True))
        with _refusing():
            self._parser.close()
        return self._builder.take()

    def read(self, chunks: Iterable[bytes | str]) -> Iterator[XmlElement]:
        """Yield the wanted elements of a whole file that comes in *chunks*."""
        for chunk in chunks:
            yield from self.feed(chunk)
        yield from self.close()

    def _parse(self, text: str) -> None:
        # Always parts of one size: a token that never ends is found after each of them.
        for start in range(0, len(text), CHUNK):
            part = text[start : start + CHUNK]
            with _refusing():
                self._parser.feed(part)
                self._parsed += len(part.encode())
            if self._parsed - self._expat.CurrentByteIndex > self._limits.text:
                raise XmlError(
                    "a tag, comment or text is too long",
                    line=self._expat.CurrentLineNumber,
                    expected=f"at most {self._limits.text} characters",
                )


def read_tree(
    chunks: Iterable[bytes | str],
    *,
    roots: Collection[str] = (),
    limits: XmlLimits = DEFAULT_LIMITS,
) -> XmlElement:
    """Return the root of a file with everything in it; arguments as for XmlReader."""
    (root,) = XmlReader(("*",), roots=roots, limits=limits).read(chunks)
    return root


class _TreeBuilder:
    """Target of the parser: keeps the elements of interest, with their lines."""

    def __init__(
        self,
        wanted: frozenset[str],
        roots: tuple[str, ...],
        ignored: frozenset[str],
        limits: XmlLimits,
        select: Callable[[XmlElement], bool] | None,
    ) -> None:
        self.root: XmlElement | None = None
        self.above: dict[str, XmlElement] = {}
        self.expat: object = None
        self._roots = roots
        self._ignored = ignored
        self._limits = limits
        self._select = select
        self._takes_root = "*" in wanted
        self._wanted = wanted
        # Only inside these is there anything that is wanted.
        self._leading = {path[:end] for path in wanted for end in _slashes(path)}
        self._path: list[str] = []
        self._open: list[XmlElement] = []
        self._texts: list[list[str]] = []
        self._length = 0
        self._count = 0
        self._skipped = 0
        self._depth = 0
        self._done: list[XmlElement] = []

    def take(self) -> list[XmlElement]:
        """Return the elements that were completed since the last call."""
        done, self._done = self._done, []
        return done

    def start(self, tag: str, attrib: dict[str, str]) -> None:
        self._depth += 1
        # Checked in what is skipped, too: the parser keeps each open element.
        if self._depth > self._limits.depth:
            self._refuse("elements are nested too deeply", f"at most {self._limits.depth} levels")
        if self._skipped:
            self._skipped += 1
            return
        name = tag.rpartition("}")[2]
        if name in self._ignored:
            self._skipped = 1
            return
        # Without their namespaces, which vendors declare or leave out.
        attributes = {key.rpartition("}")[2]: value for key, value in attrib.items()}
        element = XmlElement(name, attributes, self._line())
        if not self._open:
            self._enter(element)
            return
        self._count += 1
        if self._count > self._limits.elements:
            self._refuse(
                f"{self._open[0].tag} has too many elements", f"at most {self._limits.elements}"
            )
        self._open[-1].children.append(element)
        self._push(element)

    def _enter(self, element: XmlElement) -> None:
        """Take, follow or skip an element that is in none of the wanted ones."""
        if self.root is None:
            self.root = element
            if self._roots and element.tag not in self._roots:
                self._refuse(f"it begins with {element.tag!r}", " or ".join(self._roots))
        path = "/".join([*self._path, element.tag])
        if path in self._wanted or (self._takes_root and not self._path):
            if self._select is not None and not self._select(element):
                self._skipped = 1
                return
            self._count = 0
            self._push(element)
        elif path in self._leading:
            self.above[path] = element
            self._path.append(element.tag)
        else:
            self._skipped = 1

    def _push(self, element: XmlElement) -> None:
        self._open.append(element)
        self._texts.append([])
        self._length = 0

    def data(self, text: str) -> None:
        if self._skipped or not self._open:
            return
        self._length += len(text)
        if self._length > self._limits.text:
            self._refuse(
                f"the text of {self._open[-1].tag} is too long",
                f"at most {self._limits.text} characters",
            )
        self._texts[-1].append(text)

    def end(self, tag: str) -> None:
        self._depth -= 1
        if self._skipped:
            self._skipped -= 1
        elif not self._open:
            self._path.pop()
        else:
            element = self._open.pop()
            texts = self._texts.pop()
            # Between children there is nothing but white space in all of these formats.
            element.text = "" if element.children else "".join(texts).strip()
            if not self._open:
                self._done.append(element)

    def close(self) -> None:
        """The parser's way to ask for the result, which ``take`` returns."""

    def _line(self) -> int:
        return int(getattr(self.expat, "CurrentLineNumber", 0))

    def _refuse(self, message: str, expected: str) -> NoReturn:
        raise XmlError(message, line=self._line(), expected=expected)


def _slashes(path: str) -> Iterator[int]:
    return (at for at, each in enumerate(path) if each == "/")


def _shortened(text: str) -> str:
    return text if len(text) <= 40 else f"{text[:40]}…"


@contextmanager
def _refusing() -> Iterator[None]:
    """Turn the errors of the parser into XmlError."""
    from defusedxml.common import DefusedXmlException

    try:
        yield
    except XmlError:
        raise
    except DefusedXmlException:
        message = "it declares entities or a document type"
        raise XmlError(message, expected="plain elements") from None
    except (SyntaxError, ValueError) as exc:
        line = getattr(exc, "position", (0, 0))[0]
        words = str(exc).partition(": line ")[0]
        raise XmlError(f"not XML that can be read: {words}", line=line) from None


_DECLARED = re.compile(rb"""\s*<\?xml[^>]*\sencoding\s*=\s*["']([A-Za-z0-9._-]+)["']""")
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_ENCODING = re.compile(
    r"utf-?8|us-ascii|ascii|iso-?8859-\d\d?|latin-?1|windows-125\d", re.IGNORECASE
)
_DECLARATION = 256
"""Bytes within which the declaration ends."""


class _Decoder:
    """Bytes to text, in the encoding of the byte order mark or of the declaration."""

    def __init__(self) -> None:
        self._head = b""
        self._decoder: codecs.IncrementalDecoder | None = None

    def decode(self, data: bytes, *, final: bool = False) -> str:
        """Return the text of the next bytes; raise XmlError for an unknown encoding."""
        if self._decoder is None:
            self._head += data
            if len(self._head) < _DECLARATION and not final:
                return ""
            data, self._head = self._head, b""
            self._decoder = _decoder_for(data)
        return self._decoder.decode(data, final)


def _decoder_for(head: bytes) -> codecs.IncrementalDecoder:
    """Return the decoder of a file that begins with *head*; raise XmlError if there is none."""
    for mark, encoding in _MARKS:
        if head.startswith(mark):
            return codecs.getincrementaldecoder(encoding)("replace")
    # XML without mark and declaration is UTF-8 (XML 1.0).  A declaration that was read byte by
    # byte is not UTF-16: programs of .NET write that name in files that they then save as UTF-8.
    declared = _DECLARED.match(head)
    name = declared[1].decode() if declared else "utf-8"
    name = "utf-8" if name.lower() == "utf-16" else name
    try:
        if _ENCODING.fullmatch(name):
            return codecs.getincrementaldecoder(name)("replace")
    except LookupError:
        pass
    message = f"not XML that can be read: its encoding is {_shortened(name)!r}"
    raise XmlError(message, line=1, expected="UTF-8, UTF-16, ISO-8859 or Windows-125x")
