"""Audit of changes and denied requests: one JSON object a line, appended to a file.

Rule 1: a line is in the file before the client has its answer, so a kill loses at most the current
request.
Rule 2: lines of a client that floods are counted instead; those of others are written all the same.
Rule 3: lines that cannot be written are counted: ``status`` and the log say so, and the file itself
as soon as it can be written again.
Rule 4: lines are appended as a whole.  If the disk takes only a part, that part is removed again.
Rule 5: an incomplete last line (power failure, another program) is terminated first.
Rule 6: appliances of one plant share the file; the writer holds its lock.
"""

from __future__ import annotations

import asyncio
import errno
import fcntl
import logging
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from time import monotonic, time
from typing import Any, NamedTuple, TypeAlias

import msgspec

from eap.ads.request import Operation, Read, ReadWrite, WriteControl
from eap.ams.access import AddRoute, AuditedOperation, AuditEntry, group_and_offset, host_of
from eap.ams.directory import Directory
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.coe import CoeHeader, SdoHeader
from eap.codec.mailbox import MailboxType
from eap.control.bus import BusOpenParameters, MailboxData, kind_of
from eap.control.device import ApplyAnswer, StateAnswer
from eap.control.protocol import Request
from eap.gateway.requests import error_in, operation_of
from eap.ids import ObjectId
from eap.net.limits import Rate, SourceRateLimiter, SourceRates
from eap.od.abort import SdoAbortError

MAX_BYTES = 8 << 20
"""Of the file before it is put aside."""
KEPT = 4
"""Older files."""
# O_NOFOLLOW: a link in the folder must not redirect the audit.
_FLAGS = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
# All clients of the process wait meanwhile, so after one wait in vain there is none until the lock
# was had again: another process may be stopped while it holds it.
LOCK_S = 0.2
"""Longest wait for the lock, which others hold as long as it takes to write a few lines."""


class AuditFile:
    """Audit file; older files have ``.1`` and so on appended to their names.

    Attributes:
        path: Of the file, in a folder that only its owner may enter.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._wait_s = LOCK_S

    def append(self, lines: bytes) -> None:
        """Append *lines*, all of them or nothing.

        Raises:
            OSError: they cannot be written; the file is as it was.
        """
        fd = self._open_locked()
        try:
            size = os.fstat(fd).st_size
            # A process that was killed may have left a part of a line: it must not join the next
            # one.
            if size and os.pread(fd, 1, size - 1) != b"\n":
                lines = b"\n" + lines
            try:
                _write_all(fd, lines)
            except OSError:
                # A part of a line would hide the next one from readers.
                os.ftruncate(fd, size)
                raise
            if size + len(lines) >= MAX_BYTES:
                with suppress(OSError):  # the lines are written; the next ones try it again
                    self._put_aside()
        finally:
            os.close(fd)

    def _open_locked(self) -> int:
        """Open the file and lock it."""
        deadline_s = monotonic() + self._wait_s
        while (fd := self._try_lock()) < 0:
            if monotonic() >= deadline_s:
                self._wait_s = 0.0
                raise OSError(errno.EAGAIN, "another process holds its lock")
            # No sleep: another process holds the lock for as long as one write takes.
            os.sched_yield()
        self._wait_s = LOCK_S
        return fd

    def _try_lock(self) -> int:
        """Return the locked file, -1 if another process has its lock or has just moved it away."""
        fd = self._open()
        is_locked = False
        try:
            with suppress(BlockingIOError, FileNotFoundError):
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # Another process may have rotated the file between open and lock.
                is_locked = os.path.samestat(os.fstat(fd), self.path.stat())
        finally:
            if not is_locked:
                os.close(fd)
        return fd if is_locked else -1

    def _open(self) -> int:
        try:
            return os.open(self.path, _FLAGS, 0o640)
        except FileNotFoundError:
            # The folder may be removed while the plant runs.
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            return os.open(self.path, _FLAGS, 0o640)

    def _put_aside(self) -> None:
        names = [self.path.with_name(f"{self.path.name}.{number}") for number in range(1, KEPT + 1)]
        for older, newer in zip(reversed(names[1:]), reversed(names[:-1]), strict=True):
            if newer.exists():
                newer.replace(older)
        # The file itself is moved last: a failure before leaves it in its place.
        self.path.replace(names[0])


def _write_all(fd: int, data: bytes) -> None:
    """Write *data*; the rest of a short write is tried again, for the reason why it was short."""
    while data:
        data = data[os.write(fd, data) :]


BURST, PER_S = 500, 50
"""Lines that a client may cause at once, and in each second for long."""
TRANSPORT_RATE = Rate(5000, 500)
"""Likewise, of all clients of a transport."""
# The addresses of new clients can be invented.
NEW_RATE = Rate(500, 50)
"""Likewise, of all its clients that were never seen."""
CONTROL = "control"
"""Stands for a transport in lines about clients of the control socket."""
TOO_MANY = f"the audit is required, and records at most {PER_S} changes a second of one client"
_MAX_CLIENTS = 1024
"""More than can be new at once: invented addresses do not make known clients forgotten."""
_PLAIN = 8
"""Octets of a value that is written as it is; of longer ones there is a digest."""
_REPORT_S = 1.0
_COMPLETE = 0x100

_CONTROL_RATES = SourceRates(
    Rate(BURST, PER_S), known=TRANSPORT_RATE, new=TRANSPORT_RATE, local=TRANSPORT_RATE
)
_RATES = SourceRates(Rate(BURST, PER_S), known=TRANSPORT_RATE, new=NEW_RATE, local=TRANSPORT_RATE)
_Client: TypeAlias = tuple[str, str, str]
"""Station, transport, and address without its TCP port."""

logger = logging.getLogger(__name__)


class Lost(NamedTuple):
    """Lines that could not be written."""

    lines: int
    since: float | None
    """Unix time at which the first one was lost."""
    until: float | None
    """Unix time at which the last one was lost."""
    error: str
    """Reason that no line can be written now; empty if it can."""


class Audit:
    """The audit of a plant's stations on this host.

    Args:
        file: Where lines go.
        directory: Names of targets.
        is_required: Whether changes that cannot be recorded are refused: each has a line before it
            is done, too.
        clock: In seconds, for rates.
        now: Unix time in seconds.

    Attributes:
        lost: What could not be written since this process began.
    """

    def __init__(
        self,
        file: AuditFile,
        directory: Directory,
        *,
        is_required: bool = False,
        clock: Callable[[], float] = monotonic,
        now: Callable[[], float] = time,
    ) -> None:
        self.lost = Lost(0, None, None, "")
        self.is_required = is_required
        self._file = file
        self._directory = directory
        self._clock = clock
        self._now = now
        self._limiters: dict[tuple[str, str], SourceRateLimiter] = {}
        self._skipped: dict[_Client, int] = {}
        self._unreported = 0
        self._unreported_since = 0.0

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self._file.path

    async def serve(self) -> None:
        """Write the numbers of skipped and lost lines, until cancelled."""
        try:
            while True:
                await asyncio.sleep(_REPORT_S)
                self.write_skipped()
                self.write_lost()
        finally:
            self.write_skipped()
            self.write_lost()

    def report(self) -> dict[str, Any]:
        """Return the entry of ``status``."""
        return {"file": str(self.path), "required": self.is_required, **self.lost._asdict()}

    def begin(self, station: str, entry: AuditEntry) -> str:
        """Write the intended change of a station; return the reason if it cannot be recorded."""
        client = station, entry.endpoint.transport, host_of(entry.endpoint)
        if not all(self._allow(client) for _ in entry.operations):
            return TOO_MANY
        head = self._head(station, entry)
        lines = [head | _intent_fields(each) for each in entry.operations]
        return "" if self._append(lines, are_counted=False) else self._refusal_text()

    def begin_request(self, peer: str, station: str, fields: dict[str, Any]) -> str:
        """Write the intended change of a client of the control socket, if the audit is required.

        Returns:
            Why it cannot be recorded, and hence not be done; empty if it can.
        """
        if not self.is_required:
            return ""
        why = TOO_MANY
        if self._allow((station, CONTROL, peer)):
            line = self._request_head(peer, station) | fields | {"begins": True}
            if self._append([line], are_counted=False):
                return ""
            why = self._refusal_text()
        self._write_limited(peer, station, fields | {"error": why})
        return why

    def _refusal_text(self) -> str:
        return f"the audit is required and cannot be written: {self.lost.error}"

    def write(self, station: str, entry: AuditEntry) -> None:
        """Write a change that a station made or denied."""
        client = station, entry.endpoint.transport, host_of(entry.endpoint)
        head = self._head(station, entry)
        lines = []
        for each in entry.operations:
            # The rate of a required audit was charged when the change began.
            has_begun = self.is_required and each.decision.is_allowed
            if has_begun or self._allow(client):
                lines.append(head | _result_fields(each))
            else:
                self._skip(client)
        if lines:
            self._append(lines)

    def write_request(self, peer: str, station: str, fields: dict[str, Any]) -> None:
        """Write a change of a client of the control socket, made or denied.

        If that is required, :meth:`begin_request` has limited it already.
        """
        if self.is_required:
            self._append([self._request_head(peer, station) | fields])
        else:
            self._write_limited(peer, station, fields)

    def write_login(self, transport: str, host: str, user: str, count: int, why: str) -> None:
        """Write *count* refused logins of a user from a host."""
        client = "", transport, host
        if not self._allow(client):
            self._skip(client)
            return
        head = {"time": self._time(), "station": "", "transport": transport, "from": host}
        fields = {"operation": "login", "user": user, "count": count, "allowed": False, "why": why}
        self._append([head | fields])

    def _write_limited(self, peer: str, station: str, fields: dict[str, Any]) -> None:
        client = station, CONTROL, peer
        if self._allow(client):
            self._append([self._request_head(peer, station) | fields])
        else:
            self._skip(client)

    def _request_head(self, peer: str, station: str) -> dict[str, Any]:
        return {"time": self._time(), "station": station, "transport": CONTROL, "from": peer}

    def write_skipped(self) -> None:
        """Write how many lines were left out, for each client that had some."""
        skipped, self._skipped = self._skipped, {}
        lines = [
            {
                "time": self._time(),
                "station": station,
                "transport": transport,
                "from": peer,
                "skipped": count,
            }
            for (station, transport, peer), count in skipped.items()
        ]
        if lines:
            self._append(lines)

    def _allow(self, client: _Client) -> bool:
        """Take one line for a client; return whether the rates allow it."""
        station, transport, peer = client
        now = self._clock()
        limiter = self._limiters.get((station, transport))
        if limiter is None:
            # Each command is a process of its own, and a new client of the control socket.
            rates = _CONTROL_RATES if transport == CONTROL else _RATES
            limiter = self._limiters[station, transport] = SourceRateLimiter(
                rates, _MAX_CLIENTS, now
            )
        return limiter.take(peer, now)

    def _skip(self, client: _Client) -> None:
        """Count a line that is left out."""
        # Written early rather than forgotten, whatever the number of clients.
        if client not in self._skipped and len(self._skipped) >= _MAX_CLIENTS:
            self.write_skipped()
        self._skipped[client] = self._skipped.get(client, 0) + 1

    def _head(self, station: str, entry: AuditEntry) -> dict[str, Any]:
        header = entry.header
        return {
            "time": self._time(),
            "station": station,
            "transport": entry.endpoint.transport,
            "from": entry.endpoint.connection,
            "source": f"{header.source}:{header.source_port}",
            "target": f"{header.target}:{header.target_port}",
            "name": self._directory.name_of(header.target, header.target_port),
            "route": entry.route,
        }

    def _time(self) -> str:
        return _text_of(self._now())

    def write_lost(self) -> None:
        """Write how many lines were lost, if there are such, and the file can be written again."""
        if self._unreported:
            self._append([])

    def _append(self, lines: list[dict[str, Any]], *, are_counted: bool = True) -> bool:
        """Write all of *lines*, or none; say which.

        Args:
            lines: One object each.
            are_counted: Whether they are lost when they cannot be written: a change has been made,
                or refused, that is not recorded.
        """
        head = [self._lost_line()] if self._unreported else []
        data = b"".join(msgspec.json.encode(line) + b"\n" for line in (*head, *lines))
        try:
            self._file.append(data)
        except OSError as exc:
            self._lose(len(lines) if are_counted else 0, exc.strerror or str(exc))
            return False
        if self._unreported:
            logger.warning(
                "audit %s: written again; %d lines are lost", self.path, self._unreported
            )
        self._unreported = 0
        self.lost = self.lost._replace(error="")
        return True

    def _lose(self, count: int, error: str) -> None:
        if not self.lost.error:
            effect = "refused" if self.is_required else "not recorded"
            logger.error("audit %s: changes are %s: %s", self.path, effect, error)
        self.lost = self.lost._replace(error=error)
        if count:
            now = self._now()
            self._unreported_since = self._unreported_since if self._unreported else now
            self._unreported += count
            self.lost = Lost(self.lost.lines + count, self.lost.since or now, now, error)

    def _lost_line(self) -> dict[str, Any]:
        return {
            "time": self._time(),
            "lost": self._unreported,
            "since": _text_of(self._unreported_since),
            "until": _text_of(self.lost.until or 0.0),
            "error": self.lost.error,
        }


def _text_of(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds")


def _intent_fields(each: AuditedOperation) -> dict[str, Any]:
    decision = each.decision
    fields = {"service": decision.service, "allowed": True, "why": decision.why, "begins": True}
    return dict(operation_fields(each.operation)) | fields


def _result_fields(each: AuditedOperation) -> dict[str, Any]:
    decision, result = each.decision, each.result
    return dict(operation_fields(each.operation)) | {
        "service": decision.service,
        "allowed": decision.is_allowed,
        "why": decision.why,
        "result": result,
        "error": "" if not result else AdsError.words_of(result),
    }


def operation_fields(operation: Operation | AddRoute) -> Iterator[tuple[str, Any]]:
    """Yield the fields that describe an operation."""
    yield "operation", type(operation).__name__
    if isinstance(operation, AddRoute):
        yield "adds", operation._asdict()
        return
    group, offset = group_and_offset(operation)
    if group is not None:
        yield "group", f"0x{group:X}"
        yield "offset", f"0x{offset:X}"
    if group == IndexGroup.SDO:
        whole = " (complete access)" if offset & _COMPLETE else ""
        yield "object", str(ObjectId(offset >> 16, offset & 0xFF)) + whole
    if isinstance(operation, WriteControl):
        yield "states", [operation.ads_state, operation.device_state]
    data = getattr(operation, "data", None)
    if data is None:
        return
    yield "length", len(data)
    if group == IndexGroup.FOE_OPEN_WRITE:
        yield "file", data.rstrip(b"\0").decode("latin-1")[:256]
    elif len(data) <= _PLAIN:
        yield "value", data.hex()
    else:
        yield "sha256", sha256(data).hexdigest()[:16]


_CHANGES = frozenset(
    (
        *("write", "stop", "od_write", "request_state", "apply", "rollback"),
        *("bus_bring", "bus_fault", "bus_forget", "bus_transfer", "gateway_start", "gateway_stop"),
        *("routes_add", "routes_remove", "routes_import", "routes_add_remote"),
        *("routing_apply", "routing_rollback", "set_log_level"),
    )
)
_HIDDEN = frozenset(("password", "spec", "xml", "routing"))
"""Parameters that are secret, or as long as a plant file."""
_READ_COMMANDS = frozenset((1, 4, 7))
"""Datagrams that only read: APRD, FPRD, BRD (ETG.1000.4)."""
_EEPROM_OWNER, _EEPROM_CONTROL, _EEPROM_READ = 0x0500, 0x0502, "0001"
"""Registers, and how the command begins that reads (ETG.1000.4)."""
_MAX_TEXT = 200


def change_of(
    request: Request, opened: Callable[[int], BusOpenParameters | None]
) -> tuple[str, dict[str, Any]] | None:
    """Return the station that a request changes, and fields for the audit; None if it only reads.

    Args:
        request: As it came, not checked yet.
        opened: Returns how a conversation with a slave was opened, None if there is none.
    """
    params = request.params
    if request.method == "bus_ask":
        number = params.get("conversation")
        conversation = opened(number) if isinstance(number, int) else None
        return None if conversation is None else _conversation_change(conversation, params)
    if not _is_change(request):
        return None
    described = {key: _shortened(value) for key, value in params.items() if key not in _HIDDEN}
    described.pop("origin", None)
    origin = params.get("origin")
    author = {}
    if isinstance(origin, dict):
        author = {key: _shortened(origin.get(key, "")) for key in ("user", "host", "comment")}
        client = "@".join(str(author[key]) for key in ("user", "host") if author[key])
        author["by"] = f"{_shortened(origin.get('transport', 'web'))}:{client}"
    station = str(
        described.pop("station", "") or str(described.get("target", "")).partition("/")[0]
    )
    return station, {"operation": request.method, "asked": described} | author


def _is_change(request: Request) -> bool:
    if request.method == "ams_ask":
        # An ADS request has a line of its own, which does not know its author.
        return request.params.get("origin") is not None
    if request.method == "bus_transfer":
        return not _are_reads(request.params)
    return request.method in _CHANGES


def error_in_result(result: Any, conversation: BusOpenParameters | None = None) -> str:
    """Return why a result says that it was not done, empty if it was.

    Args:
        result: Of a request.
        conversation: How the conversation was opened that it is an answer of, if it is one.
    """
    if conversation is not None and isinstance(result, MailboxData):
        kind, answer = kind_of(conversation.protocol), bytes.fromhex(result.data)
        code = error_in(kind, answer)
        if code and kind is MailboxType.COE:
            head = SdoHeader.decode(answer, CoeHeader.SIZE)
            return str(SdoAbortError(head.value, head.index, head.subindex))
        return AdsError.words_of(code) if code else ""
    if isinstance(result, StateAnswer) and result.error is not None:
        return result.error.text
    return "; ".join(result.refused) if isinstance(result, ApplyAnswer) else ""


def _conversation_change(
    conversation: BusOpenParameters, params: Mapping[str, Any]
) -> tuple[str, dict[str, Any]] | None:
    try:
        body = bytes.fromhex(params["request"])
    except (KeyError, TypeError, ValueError):
        return None
    operation = operation_of(kind_of(conversation.protocol), body)
    if operation is None or params.get("listen") or _is_read(operation):
        return None
    name = f"{conversation.station}/{conversation.port}/{conversation.slave}"
    return conversation.station, {"name": name} | dict(operation_fields(operation))


def _is_read(operation: Operation) -> bool:
    is_lookup = isinstance(operation, ReadWrite) and operation.group == IndexGroup.FOE_OPEN_READ
    return is_lookup or isinstance(operation, Read)


def _are_reads(params: Mapping[str, Any]) -> bool:
    rows = params.get("datagrams")
    return not isinstance(rows, list) or all(map(_is_read_row, rows))


def _is_read_row(row: Any) -> bool:
    """Say whether a datagram changes nothing; an EEPROM is read by writing a command."""
    match row:
        case [command, *_] if command in _READ_COMMANDS:
            return True
        case [_, _, place, data, *_]:
            # Registers 0x0500 and 0x0502: taking the EEPROM over and a read command change no
            # content.
            is_command = place == _EEPROM_CONTROL and str(data).startswith(_EEPROM_READ)
            return is_command or place == _EEPROM_OWNER
    return False


def _shortened(value: Any) -> Any:
    text = str(value)
    return value if len(text) <= _MAX_TEXT else f"{text[:_MAX_TEXT]}…"
