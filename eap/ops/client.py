"""Blocking client of the control protocol, as commands use it."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from time import monotonic
from typing import Any, TypeVar

import msgspec

from eap.closeable import Closeable
from eap.codec import datatypes
from eap.codec.datatypes import DataType, find_variable, is_finite
from eap.control.protocol import (
    MAX_LINE,
    SUBSCRIBE,
    VARIABLES,
    WRITE,
    AnswerT,
    ControlReply,
    ErrorCode,
    Method,
    ParametersT,
    ValuesEvent,
    decode_reply,
    encode_request,
)
from eap.errors import ControlError
from eap.runtime.bus_errors import ErrorRecord, to_error
from eap.runtime.folder import ApplianceFolder, ApplianceInfo, describe_roots, find_running
from eap.suggest import suggest

T = TypeVar("T")

TIMEOUT_S = 10.0
"""Time for one answer: services may be restarting."""
STATUS_S = 3.0
"""Time for the answers of several appliances, when one of them has answered."""
_PING_S = 2.0
"""Time after which a request without an answer is followed by a ping, and time for its answer."""
_PINGED_S = 30.0
"""Longest time for an answer with a ping: a change may occupy services longer than _PING_S."""
_LISTED = 4
_CONNECT_PAUSE_S = 0.02
_EVENT = partial(msgspec.convert, type=ValuesEvent)


class ControlClient(Closeable):
    """One connection to one running appliance."""

    def __init__(
        self, connection: socket.socket, info: ApplianceInfo, folder: ApplianceFolder | None = None
    ) -> None:
        self.info = info
        self._folder = folder
        self._socket = connection
        self._socket.settimeout(TIMEOUT_S)
        self._reader = connection.makefile("rb")
        self._last_id = 0

    def call(
        self,
        method: Method[ParametersT, AnswerT],
        /,
        *,
        within_s: float = TIMEOUT_S,
        **params: Any,
    ) -> AnswerT:
        """Return the answer to *method*, which may take *within_s*.

        Raises:
            ControlError: the appliance refused, or does not answer.
            BusError: a bus or a slave refused or failed.
        """
        return method.decode(self.request_within(within_s, method.name, **params))

    def request(self, method: str, /, **params: Any) -> Any:
        """Return the result of *method*.

        Raises:
            ControlError: the appliance refused, or does not answer.
        """
        return self.request_within(TIMEOUT_S, method, **params)

    def request_within(self, within_s: float, method: str, /, **params: Any) -> Any:
        """Return the result of *method*, which may take *within_s*.

        Raises:
            ControlError: the appliance refused, or does not answer.
            BusError: a bus or a slave refused or failed.
        """
        self.send(within_s, method, **params)
        if _PING_S < within_s < _PINGED_S and not self.has_data(_PING_S) and self.is_hung():
            raise self.hung()
        return self.receive()

    def send(self, within_s: float, method: str, /, **params: Any) -> None:
        """Send a request, whose result :meth:`receive` returns within *within_s*.

        Raises:
            ControlError: the appliance does not read it.
        """
        self._last_id += 1
        # Each request has a limit of its own: a state change of slaves takes longer than a read.
        self._socket.settimeout(within_s)
        try:
            self._socket.sendall(encode_request(self._last_id, method, params))
        except OSError as exc:
            raise self._gone(exc) from None

    def receive(self) -> Any:
        """Return the result of the request sent last; raises as :meth:`request_within`."""
        while True:
            reply = self._next_reply()
            # Events of an earlier subscription may precede the answer.
            if reply.subscription is None:
                return checked(reply).result

    def has_data(self, timeout_s: float) -> bool:
        """Wait for *timeout_s* at most; return whether an answer or its begin has come."""
        return bool(select.select([self._socket], [], [], timeout_s)[0])

    def fileno(self) -> int:
        """Return the descriptor of the connection, for select."""
        return self._socket.fileno()

    def gone(self, why: str) -> ControlError:
        """Return the error that the appliance does not answer for the reason *why*."""
        return self._gone(TimeoutError(why))

    def hung(self) -> ControlError:
        """Return the error that services accept connections and answer none."""
        pid = self.info.services.pid
        return self.gone(f"services hangs; look at process {pid}, or restart the appliance")

    def is_hung(self) -> bool:
        """Return whether services accept connections, but answer no request on another one."""
        folder = self._folder
        if folder is None or any(_starting(folder)):
            return False
        try:
            with _connect_one(folder, self.info) as other:
                other.request_within(_PING_S, "hello")
        except ControlError as exc:
            return exc.code == ErrorCode.UNAVAILABLE and not any(_starting(folder))
        return False

    def events(self, **params: Any) -> Iterator[ValuesEvent]:
        """Subscribe with *params* and yield each event until the appliance ends.

        The connection accepts no other request meanwhile.

        Raises:
            ControlError: the appliance refused, went away, or cannot read the values now.
        """
        self.call(SUBSCRIBE, **params)
        # Events come when values change, which may take any time: no timeout from here on.
        self._socket.settimeout(None)
        while True:
            event = checked(self._next_reply()).event
            if event is None:
                continue
            if failure := event.get("error"):
                raise ControlError(failure["message"], code=failure["code"])
            yield _EVENT(event)

    def close(self) -> None:
        """Hang up, also while another thread waits for an event."""
        # Closing alone would not wake up a thread that waits in readline().
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._reader.close()
        self._socket.close()

    def _next_reply(self) -> ControlReply:
        try:
            line = self._reader.readline(MAX_LINE)
        except OSError as exc:
            raise self._gone(exc) from None
        if not line:
            raise self._gone(None)
        return decode_reply(line)

    def _gone(self, cause: OSError | None) -> ControlError:
        why = str(cause) if cause else "it closed the connection"
        if self._folder is not None:
            why = "; ".join((why, *_starting(self._folder)))
        return ControlError(
            f"appliance {_label(self.info)} does not answer: {why}",
            code=ErrorCode.UNAVAILABLE,
        )


def checked(reply: ControlReply) -> ControlReply:
    """Return *reply*; raise ControlError or BusError if it is an error."""
    error = reply.error
    if error is None:
        return reply
    if error.kind:
        raise to_error(ErrorRecord(error.kind, error.message, error.detail))
    raise ControlError(error.message, code=error.code)


def connect(plant: str | None = None, station: str | None = None) -> list[ControlClient]:
    """Connect to all running appliances, or to those that run *plant* or *station*.

    Raises:
        ControlError: there is none; the message names the running ones and the searched folders.
    """
    clients = connect_those(
        lambda info: (
            (not plant or info.plant == plant) and (not station or station in info.stations)
        )
    )
    if not clients:
        raise _none_runs(plant, station, [info for _, info in find_running()])
    return clients


def connect_those(wanted: Callable[[ApplianceInfo], bool]) -> list[ControlClient]:
    """Connect to the running appliances that are *wanted*; there may be none.

    Raises:
        ControlError: one of them cannot be reached.
    """
    clients: list[ControlClient] = []
    try:
        for folder, info in find_running():
            if wanted(info):
                clients.append(_connect_one(folder, info))
    except ControlError:
        for client in clients:
            client.close()
        raise
    return clients


def request_each(
    clients: Sequence[ControlClient], method: str, /, **params: Any
) -> tuple[list[Any], list[ApplianceInfo]]:
    """Return the results of the appliances that answer, and those that do not.

    The first answer ends the wait for the others after STATUS_S.

    Raises:
        ControlError: none answers, or one refuses.
    """
    start_s = monotonic()
    answers = _Answers(clients, method, params)
    answers.wait(start_s + _PING_S, start_s + _PING_S)
    if not answers.results and (hung := answers.find_hung()) is not None:
        raise hung
    answers.wait(start_s + STATUS_S, start_s + TIMEOUT_S)
    if not answers.results:
        raise next(iter(answers.errors), clients[0].gone("timed out"))
    ordered = [answers.results[client] for client in clients if client in answers.results]
    return ordered, [client.info for client in clients if client not in answers.results]


class _Answers:
    """Answers of several appliances to one request, which is sent at once.

    Attributes:
        results: Of those that have answered.
        errors: Of those that cannot answer.
    """

    def __init__(
        self, clients: Sequence[ControlClient], method: str, params: dict[str, Any]
    ) -> None:
        self.results: dict[ControlClient, Any] = {}
        self.errors: list[ControlError] = []
        self._waiting: list[ControlClient] = []
        for client in clients:
            try:
                client.send(TIMEOUT_S, method, **params)
            except ControlError as exc:
                self.errors.append(exc)
            else:
                self._waiting.append(client)

    def wait(self, until_s: float, first_until_s: float) -> None:
        """Wait for the missing answers until *until_s*, for the first until *first_until_s*.

        Raises:
            ControlError: an appliance refuses.
        """
        while self._waiting:
            end_s = until_s if self.results else first_until_s
            left_s = max(0.0, end_s - monotonic())
            ready, _, _ = select.select(self._waiting, [], [], left_s)
            if not ready:
                return
            for client in ready:
                self._waiting.remove(client)
                self._receive(client)

    def find_hung(self) -> ControlError | None:
        """Return the error of the first of the missing appliances if all of them hang."""
        if self._waiting and all(client.is_hung() for client in self._waiting):
            return self._waiting[0].hung()
        return None

    def _receive(self, client: ControlClient) -> None:
        try:
            self.results[client] = client.receive()
        except ControlError as exc:
            if exc.code != ErrorCode.UNAVAILABLE:
                raise
            self.errors.append(exc)


def call_each(
    clients: Iterable[ControlClient], call: Callable[[ControlClient], T]
) -> tuple[list[T], list[ControlError]]:
    """Return what *call* returns of the appliances that answer, and the errors of the others.

    Raises:
        ControlError: none answers, or one refuses.
    """
    found: list[T] = []
    silent: list[ControlError] = []
    for client in clients:
        try:
            found.append(call(client))
        except ControlError as exc:
            if exc.code != ErrorCode.UNAVAILABLE:
                raise
            silent.append(exc)
    if silent and not found:
        raise silent[0]
    return found, silent


def connect_station(station: str, plant: str | None) -> ControlClient:
    """Connect to the one running appliance that has *station*.

    Raises:
        ControlError: none has it, or several do and *plant* does not choose among them.
    """
    first, *others = connect(plant, station)
    if others:
        for client in (first, *others):
            client.close()
        plants = ", ".join(client.info.plant for client in (first, *others))
        raise ControlError(f"station {station} runs in {plants}: choose one with --plant")
    return first


class WrittenVariable(msgspec.Struct, frozen=True):
    """``eapctl pd set``."""

    station: str
    variable: str
    value: Any


def write_variable(station: str, name: str, text: str, plant: str | None) -> WrittenVariable:
    """Write *text*, a literal of the variable's type, to a variable of the application.

    Raises:
        ControlError: the value has another type, or the appliance refused.
    """
    with connect_station(station, plant) as client:
        variables = client.call(VARIABLES, station=station)
        types = {each.name: each.type for each in variables}
        value: Any = text
        try:
            # The appliance reports an unknown name itself, with a suggestion.
            if found := find_variable(
                name, lambda each: datatypes.parse(types[each]) if each in types else None
            ):
                value = _to_json(found[1].kind, text)
        except ValueError as exc:
            raise ControlError(f"variable {station}/{name}: {exc}", code="value") from None
        client.call(WRITE, station=station, values={name: value})
    return WrittenVariable(station, name, value)


def _to_json(kind: DataType, text: str) -> Any:
    """Read *text* as a value that the control protocol can carry; raise ValueError otherwise."""
    value = kind.parse_text(text)
    # JSON has no NaN and no infinity.
    if not is_finite(value):
        raise ValueError(f"{text!r} cannot be sent to the appliance: expected a finite number")
    return kind.to_plain(value)


def _connect_one(folder: ApplianceFolder, info: ApplianceInfo) -> ControlClient:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(TIMEOUT_S)
    try:
        _connect(connection, str(folder.control_socket))
    except OSError as exc:
        connection.close()
        raise ControlError(
            f"appliance {_label(info)} cannot be reached at"
            f" {folder.control_socket}: {exc.strerror}",
            code=ErrorCode.UNAVAILABLE,
        ) from None
    return ControlClient(connection, info, folder)


def _connect(connection: socket.socket, path: str) -> None:
    """Connect to a Unix socket; where too many wait to be accepted, wait for TIMEOUT_S.

    Raises:
        OSError: the socket has no listener, or did not accept in that time.
    """
    end_s = monotonic() + TIMEOUT_S
    while True:
        try:
            connection.connect(path)
        except BlockingIOError:  # the accept queue of a Unix socket is full
            if monotonic() > end_s:
                raise
            select.select([], [], [], _CONNECT_PAUSE_S)
        else:
            return


def _label(info: ApplianceInfo) -> str:
    """Return plant, stations and process: several appliances may run parts of one plant."""
    more = len(info.stations) - _LISTED
    stations = ", ".join(info.stations[:_LISTED]) + (f" and {more} more" if more > 0 else "")
    return f"{info.plant} ({stations}; process {info.supervisor})"


def _starting(folder: ApplianceFolder) -> Iterator[str]:
    """Yield the processes of an appliance that are starting or restarting, with their steps."""
    with suppress(OSError, ValueError):
        info = folder.read_info()
        processes = {"engine": info.engine, "services": info.services, **info.segments}
        for name, process in processes.items():
            if process.step:
                yield f"{name} is starting ({process.step})"
            elif not process.pid:
                yield f"{name} ended and is being restarted"


def _none_runs(
    plant: str | None, station: str | None, running: Sequence[ApplianceInfo]
) -> ControlError:
    wanted = f"station {station}" if station else f"plant {plant}" if plant else "appliance"
    if running:
        others = ", ".join(f"{info.plant} ({', '.join(info.stations)})" for info in running)
        names = [name for info in running for name in info.stations]
        hint = f"; running: {others}{suggest(station, names) if station else ''}"
    else:
        hint = f": start one with 'eapctl run PLANT' (looked in {describe_roots()})"
    return ControlError(f"no {wanted} runs{hint}", code=ErrorCode.UNAVAILABLE)
