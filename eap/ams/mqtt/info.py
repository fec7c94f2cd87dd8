"""What a router tells of itself by MQTT: a little XML (Beckhoff ADS-over-MQTT, discovery).

``<info><online name="HOST" osVersion="…" osPlatform="…" tcVersion="…">true</online></info>``; with
``false`` it is gone, which is also its last will.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple
from xml.sax.saxutils import quoteattr

from defusedxml import ElementTree

from eap.errors import MalformedError

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

MAX_INFO = 4096
"""Octets; what is longer is not read."""
MAX_NAME = 64
_UNIX = 4
"""Number of the platform; 2, which routers on Windows have, is that of Windows NT."""
_WORDS = {"true": True, "false": False}


class Info(NamedTuple):
    """What a router tells."""

    name: str
    """Of its host; empty if it does not say."""
    is_online: bool
    is_unidirectional: bool = False
    """Whether it lets nobody ask it anything."""


def encode_info(info: Info) -> bytes:
    """Return the message that tells *info*."""
    more = ' unidirectional="true"' if info.is_unidirectional else ""
    word = "true" if info.is_online else "false"
    attributes = f'name={quoteattr(info.name)} osPlatform="{_UNIX}"{more}'
    return f"<info><online {attributes}>{word}</online></info>".encode()


def decode_info(payload: bytes) -> Info:
    """Return what a message tells; nothing at all says that the router is gone.

    Raises:
        MalformedError: it is no such message, or longer than any.
    """
    if not payload:
        return Info("", is_online=False)
    online = _parse(payload).find("online")
    word = "" if online is None else (online.text or "").strip().lower()
    if online is None or word not in _WORDS:
        raise MalformedError(f"online is {word[:20]!r}, expected true or false", layout="info")
    name = "".join(filter(str.isprintable, online.get("name", ""))).strip()
    is_unidirectional = online.get("unidirectional", "").lower() == "true"
    return Info(name[:MAX_NAME], _WORDS[word], is_unidirectional)


def _parse(payload: bytes) -> Element:
    if len(payload) > MAX_INFO:
        raise MalformedError(f"{len(payload)} octets, expected at most {MAX_INFO}", layout="info")
    try:
        root: Element = ElementTree.fromstring(payload.rstrip(b"\0"), forbid_dtd=True)
    except (SyntaxError, ValueError, LookupError) as exc:
        text = str(exc)[:80] or type(exc).__name__
        raise MalformedError(f"this is not XML that is read: {text}", layout="info") from None
    if root.tag != "info":
        raise MalformedError(f"it begins with {root.tag[:20]!r}, expected 'info'", layout="info")
    return root
