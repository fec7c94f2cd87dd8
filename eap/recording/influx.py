"""Values in InfluxDB's line protocol, by HTTP or UDP: InfluxDB, Telegraf, VictoriaMetrics, QuestDB.

A line is ``STATION,plant=PLANT VALUE=…,VALUE=… TIME``, the time in nanoseconds; an event is a line
of the measurement ``recording_events``.  The token is that of the variable INFLUX_TOKEN.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable, Iterator, Sequence
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from math import isfinite
from typing import Any
from urllib.parse import urlsplit

from eap.codec.enumerations import Enumeration
from eap.codec.times import Timed
from eap.recording.header import RecordingEvent
from eap.recording.rows import plain_value
from eap.recording.stores import StoreError, StoreRow, StoreTable, lost_texts

TOKEN_VARIABLE = "INFLUX_TOKEN"  # noqa: S105  the name of the variable
_TIMEOUT_S = 5.0
_BATCH_BYTES = 4 << 20
_DATAGRAM_BYTES = 1400
_PORTS = {"influx+http": 8086, "influx+https": 8086, "influx+udp": 8089}
_NAME_ESCAPES = str.maketrans({",": "\\,", " ": "\\ ", "=": "\\=", "\n": "\\ "})
_TEXT_ESCAPES = str.maketrans({"\\": "\\\\", '"': '\\"'})
_FINAL = range(400, 500)


class InfluxStore:
    """One server.

    Args:
        url: ``influx+http://HOST:PORT/PATH?QUERY``, ``influx+https://…`` or ``influx+udp://HOST``.
    """

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        self._scheme = parts.scheme
        self._address = parts.hostname or "", parts.port or _PORTS[parts.scheme]
        query = f"{parts.query}&" if parts.query else ""
        self._path = f"{parts.path or '/write'}?{query}precision=ns"
        self._plant = ""
        self._tables: Sequence[StoreTable] = ()

    def open(self, plant: str, tables: Sequence[StoreTable]) -> None:
        """Take rows of *tables* from now on; each write has a connection of its own."""
        if self._tables is tables:
            return
        self._plant, self._tables = plant, tables
        if self._scheme == "influx+udp":
            self._resolved()  # tells at the start that the host is unknown
        else:
            # An empty write is an answer, or tells at the start that there is none.
            self._post(b"")

    def write(self, rows: Sequence[StoreRow], events: Sequence[RecordingEvent]) -> None:
        """Send all rows."""
        lines = [*self._lines(rows), *_event_lines(self._plant, events)]
        if self._scheme == "influx+udp":
            self._send(_joined(lines, _DATAGRAM_BYTES))
            return
        for body in _joined(lines, _BATCH_BYTES):
            self._post(body)

    def close(self) -> None:
        """Do nothing: there is no connection."""

    def _lines(self, rows: Iterable[StoreRow]) -> Iterator[bytes]:
        tables = [_TableLines(self._plant, table) for table in self._tables]
        for row in rows:
            if line := tables[row.table].line(row):
                yield line

    def _resolved(self) -> tuple[int, Any]:
        """Return address family and address of the host."""
        try:
            found = socket.getaddrinfo(*self._address, type=socket.SOCK_DGRAM)
        except OSError as exc:
            raise StoreError(f"{self._address[0]}: {exc.strerror}") from None
        family, _, _, _, address = found[0]
        return family, address

    def _send(self, bodies: Iterable[bytes]) -> None:
        family, address = self._resolved()
        try:
            with socket.socket(family, socket.SOCK_DGRAM) as sock:
                for body in bodies:
                    sock.sendto(body, address)
        except OSError as exc:
            raise StoreError(exc.strerror or str(exc)) from None

    def _post(self, body: bytes) -> None:
        kind = HTTPSConnection if self._scheme == "influx+https" else HTTPConnection
        connection = kind(*self._address, timeout=_TIMEOUT_S)
        headers = {"Content-Type": "text/plain; charset=utf-8"}
        if token := os.environ.get(TOKEN_VARIABLE):
            headers["Authorization"] = f"Token {token}"
        try:
            connection.request("POST", self._path, body, headers)
            answer = connection.getresponse()
            text = answer.read(1000).decode("utf-8", "replace")
        except (OSError, HTTPException) as exc:
            raise StoreError(getattr(exc, "strerror", None) or str(exc)) from None
        finally:
            connection.close()
        # An empty write is a bad request to some servers, and nothing more than that.
        if answer.status >= 300 and not (not body and answer.status == 400):
            # 408 and 429 ask for another attempt (RFC 9110, RFC 6585).
            is_final = answer.status in _FINAL and answer.status not in {408, 429}
            reason = " ".join(f"HTTP {answer.status} {text}".split())
            raise StoreError(reason, is_final=is_final)


class _TableLines:
    """Lines of one station: the names of its values are escaped once."""

    def __init__(self, plant: str, table: StoreTable) -> None:
        self._begin = f"{_name(table.station)},plant={_name(plant)} "
        self._columns = [
            (
                f"{_name(column.name.partition('/')[2])}=",
                column.kind,
                isinstance(column.kind, Enumeration | Timed),
            )
            for column in table.columns
        ]

    def line(self, row: StoreRow) -> bytes:
        """Return the line of *row*; empty if it has no value that the protocol can carry."""
        fields = []
        for (name, kind, is_named), value in zip(self._columns, row.values, strict=True):
            text = _field(plain_value(kind, value) if is_named else value)
            if text:
                fields.append(name + text)
        return f"{self._begin}{','.join(fields)} {row.time_ns}\n".encode() if fields else b""


def _name(text: str) -> str:
    return text.translate(_NAME_ESCAPES)


def _field(value: Any) -> str:
    if isinstance(value, bool):
        return "t" if value else "f"
    if isinstance(value, int):
        # Integers of the protocol are signed and have 64 bits.
        return f"{value}i" if value < 1 << 63 else repr(float(value))
    if isinstance(value, float):
        # The protocol has neither infinities nor NaN.
        return repr(value) if isfinite(value) else ""
    text = value.hex() if isinstance(value, bytes) else value
    return f'"{text.translate(_TEXT_ESCAPES)}"'


def _event_lines(plant: str, events: Iterable[RecordingEvent]) -> Iterator[bytes]:
    for time_ns, kind, station, text, count in lost_texts(list(events)):
        tags = f",plant={_name(plant)},kind={kind}"
        tags += f",station={_name(station)}" if station else ""
        yield f"recording_events{tags} text={_field(text)},count={count}i {time_ns}\n".encode()


def _joined(lines: Iterable[bytes], size: int) -> Iterator[bytes]:
    """Yield lines joined to at most *size* bytes; a longer line is alone."""
    found = bytearray()
    for line in lines:
        if found and len(found) + len(line) > size:
            yield bytes(found)
            found.clear()
        found += line
    if found:
        yield bytes(found)
