"""Bus of a running station, as commands use it over the control socket.

Conversations and procedures run here, their single steps at the running master.  Whatever a command
has begun there ends with its connection.
"""

from __future__ import annotations

import select
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from time import monotonic, monotonic_ns
from typing import Any, TypeVar

import msgspec

from devicebus.errors import FrameLostError
from devicebus.mailbox.conversation import Conversation, MailboxMessage, MailboxRequest, drive
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.master.findings import History
from devicebus.master.procedure import Procedure, Sleep, Step, StepReplies
from devicebus.master.scan import TopologyNode, find_topology
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import DatagramReply, fprd
from devicebus.wire.register import AlStatus, DlStatus, Register
from eap.control import bus as words
from eap.control.protocol import AnswerT, Method, ParametersT
from eap.errors import ControlError
from eap.ops.bus_session import Begin, BusMismatch, Slave, SlaveBus
from eap.ops.client import ControlClient, connect_station
from eap.runtime.bus_status import (
    FrameCounts,
    count_frames,
    history_of,
    is_silent,
    report_findings,
)
from eap.runtime.engine_messages import BusReport, EoeReport, LockState, SlaveReport, no_mailbox

T = TypeVar("T")

REPORT_S = 0.1
"""Interval of calls of *meanwhile*."""

_SERVICES_MARGIN_S = 10.0
"""For services on its way back from a restart, beyond what it waits for itself."""
_S = 1_000_000_000
_PER_STEP = 60


class RunningBus(SlaveBus):
    """One bus port of a running station.

    Args:
        client: Connected to the appliance, for this bus alone.
        station: Name of the station.
        port: Name of its bus port.
    """

    def __init__(self, client: ControlClient, station: str, port: str) -> None:
        self._client = client
        self._where = {"station": station, "port": port}
        self._report = BusReport(is_up=False)
        self._reports: dict[int, SlaveReport] = {}

    def scan(self) -> Sequence[Slave]:
        """Return the slaves that the running master knows, with their present states."""
        slaves = self.known()
        if is_silent(self._report):
            finding, *_ = report_findings(self._report)
            raise FrameLostError(f"{finding.what}; {finding.advice}")
        # The report of the master is from its last cycle; the registers are read now.
        present = [slave.station for slave in slaves if not slave.is_absent]
        registers = self.run(_read_registers(present))
        nodes = find_topology([dl_status for _, dl_status in registers])
        rows = iter(zip(registers, nodes, strict=True))
        return [
            slave if slave.is_absent else _with_registers(slave, *next(rows)) for slave in slaves
        ]

    def known(self) -> Sequence[Slave]:
        """Return the slaves as the running master has them, without access to them."""
        self._report = self._describe()
        reports = self._report.slaves
        self._reports = {report.station: report for report in reports}
        return [_slave(report) for report in reports]

    def mismatch(self) -> BusMismatch | None:
        """Return found and expected slaves of a bus that is not as configured, else None."""
        # Without waiting: such a bus comes up only when somebody changes it.
        report = self._call(words.BUS_DESCRIBE, words.BUS_WAIT_UP_S, wait=False)
        if report.is_up or not report.refused:
            return None
        found, expected = (
            [_slave(each) for each in rows] for rows in (report.refused, report.slaves)
        )
        return BusMismatch(report.fault, found, expected)

    def history(self) -> History:
        """Return the recorded faults of the running master, as of the last :meth:`known`."""
        return history_of(self._report)

    def forget(self) -> None:
        """Clear past faults of the running master."""
        self._call(words.BUS_FORGET, words.BUS_WAIT_UP_S)

    def converse(
        self,
        slave: Slave,
        begin: Begin[T],
        name: str,
        meanwhile: Callable[[], None] | None = None,
    ) -> T:
        """Run a conversation with a slave's mailbox and return its result."""
        del name  # the master has its own
        report = self._reports[slave.station]
        if not report.to_slave:
            raise no_mailbox(report)
        conversation = begin(MailboxSizes(report.to_slave, report.to_master))
        return self._drive(slave, conversation, meanwhile)

    def bring(self, slaves: Sequence[Slave], target: AlState) -> None:
        """Bring slaves to a state, which the master then keeps."""
        # Station 0 is all slaves: the master then brings them to the state together.
        is_all = {slave.station for slave in slaves} == set(self._reports)
        for station in [0] if is_all else [slave.station for slave in slaves]:
            self._call(words.BUS_BRING, words.BRING_S, slave=station, state=target.name)

    def run(self, procedure: Procedure[T], name: str = "a procedure") -> T:
        """Run a procedure to its end and return its result, or raise its error."""
        del name
        return drive(procedure, self._step)

    def lock_state(self) -> LockState | None:
        """Return the lock of the cycle to the clocks of the bus, as of the last :meth:`known`."""
        return self._report.lock

    def reports(self) -> Mapping[int, SlaveReport]:
        """Return the reports of the master by station address, as of the last :meth:`known`."""
        return self._reports

    def eoe_report(self) -> EoeReport | None:
        """Return the state of the Ethernet switch as of the last :meth:`known`; None without."""
        return self._report.eoe

    def frame_counts(self) -> FrameCounts:
        """Return the frames of the master since the engine started."""
        return count_frames(self._describe())

    def _describe(self) -> BusReport:
        return self._call(words.BUS_DESCRIBE, words.BUS_WAIT_UP_S, wait=True)

    def _step(self, step: Step) -> StepReplies:
        if isinstance(step, Sleep):
            select.select([], [], [], max(0, step.duration_ns) / _S)
            return StepReplies((), monotonic_ns())
        rows = [words.datagram_row(each) for each in step]
        answer = self._call(words.BUS_TRANSFER, words.TRANSFER_S, datagrams=rows)
        return StepReplies(words.to_replies(answer.replies), monotonic_ns())

    def _drive(
        self, slave: Slave, conversation: Conversation[T], meanwhile: Callable[[], None] | None
    ) -> T:
        report_s = 0.0
        number: int | None = None

        def exchange(request: MailboxRequest) -> MailboxMessage:
            nonlocal report_s, number
            if number is None:
                number = self._open(slave, request)
            elif meanwhile is not None and monotonic() >= report_s:
                meanwhile()
                report_s = monotonic() + REPORT_S
            return MailboxMessage(request.type, self._exchange(number, request), monotonic_ns())

        try:
            return drive(conversation, exchange)
        except KeyboardInterrupt:
            number = None  # an answer may be pending: closing the connection ends the conversation
            raise
        finally:
            if number is not None:
                with suppress(ControlError):
                    self._client.call(words.BUS_CLOSE, conversation=number)

    def _open(self, slave: Slave, request: MailboxRequest) -> int:
        protocol = words.protocol_of(request.type)
        opened = self._call(words.BUS_OPEN, words.TURN_S, slave=slave.station, protocol=protocol)
        return opened.conversation

    def _exchange(self, number: int, request: MailboxRequest) -> bytes:
        # Longer than each of the waits below: the innermost one then reports the exact reason.
        limit_s = (
            (request.timeout_ns + request.delay_ns) / _S
            + words.ENGINE_MARGIN_S
            + _SERVICES_MARGIN_S
        )
        answer = self._client.call(
            words.BUS_ASK,
            within_s=limit_s,
            conversation=number,
            **words.request_parameters(request),
        )
        return bytes.fromhex(answer.data)

    def _call(self, method: Method[ParametersT, AnswerT], limit_s: float, **params: Any) -> AnswerT:
        return self._client.call(
            method, within_s=limit_s + _SERVICES_MARGIN_S, **self._where, **params
        )


@contextmanager
def open_running(station: str, port: str, plant: str | None = None) -> Iterator[RunningBus]:
    """Connect to the appliance that runs a station, for the length of a block.

    Raises:
        ControlError: none runs it, or several do and *plant* does not choose among them.
    """
    with connect_station(station, plant) as client:
        yield RunningBus(client, station, port)


def _slave(report: SlaveReport) -> Slave:
    return Slave(
        station=report.station,
        name=report.name,
        vendor=report.vendor,
        product=report.product,
        revision=report.revision,
        serial=report.serial,
        alias=report.alias,
        status=AlStatus(report.state),
        protocols=report.protocols,
        parent=None,
        ports=(),
        fault=report.fault,
        target=report.target,
        since_ns=report.since_ns if report.fault else None,
        mailbox_timeouts=report.mailbox_timeouts,
        mailbox_late=report.mailbox_late,
        is_absent=report.is_absent,
    )


def _with_registers(slave: Slave, read: tuple[AlStatus, DlStatus], node: TopologyNode) -> Slave:
    al_status, _ = read
    return msgspec.structs.replace(
        slave,
        status=al_status,
        parent=node.parent,
        ports=node.ports,
        parent_port=node.parent_port,
    )


def _read_registers(stations: Sequence[int]) -> Procedure[list[tuple[AlStatus, DlStatus]]]:
    """Read position and wiring of slaves; zeros for one that does not answer."""
    replies: list[DatagramReply] = []
    # Two datagrams each: a request to the engine takes 256 at most.
    for start in range(0, len(stations), _PER_STEP):
        answers, _ = yield [
            access
            for station in stations[start : start + _PER_STEP]
            for access in (
                fprd(station, Register.AL_STATUS, AlStatus.SIZE),
                fprd(station, Register.DL_STATUS, DlStatus.SIZE),
            )
        ]
        replies += answers
    return [
        (
            AlStatus.decode(al.data) if al.wkc else AlStatus(0),
            DlStatus.decode(dl.data) if dl.wkc else DlStatus(),
        )
        for al, dl in zip(replies[::2], replies[1::2], strict=True)
    ]
