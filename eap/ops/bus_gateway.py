"""A bus behind a mailbox gateway, ours or anybody's, as a command uses it (ETG.8200).

A gateway passes mailbox messages, and no registers.  Slaves are known by the master's dictionary.
Not every gateway has one (KickCAT's is silent at address 0), so that it is read only for names, for
the sizes of mailboxes that files need, and for hints about refused requests.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import NoReturn, TypeVar

from devicebus.errors import (
    BusError,
    FoeError,
    MailboxRefusedError,
    MailboxTimeoutError,
    SoeError,
)
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.master.procedure import Procedure
from devicebus.wire.alstatus import AlState, state_name
from devicebus.wire.register import AlStatus
from eap.codec.mailbox import MailboxError
from eap.codec.soe import SoeErrorCode
from eap.errors import ConfigError, EapError
from eap.gateway.client import GatewayClient
from eap.gateway.error_table import Cause
from eap.gateway.requests import ALL_SLAVES, MASTER_ADDRESS, VIRTUAL_BIT, address_text
from eap.gateway.slaves import NO_DICTIONARY, MasterSlave
from eap.od.abort import AbortCode, SdoAbortError
from eap.ops.bus_session import Begin, Slave, SlaveBus, choose, no_mailbox, slave_number
from eap.runtime.bus_status import FrameCounts

T = TypeVar("T")

_MASTER_SIZE = 1480
_HINT_S = 0.3
"""Time limit of the master for each answer that only explains an error."""
_NO_ANSWER = (Cause.TIMEOUT, Cause.BUS_DOWN, Cause.UNREACHABLE)
_NO_ANSWER_HINT = (
    "if the slave did not answer, 'eapctl gateway status' and 'eapctl trace' at the gateway's"
    " station show the cause"
)


class GatewayBus(SlaveBus):
    """A bus behind a gateway, which reports no times, counters or configuration.

    Slave 0 is the master itself, with its dictionary.

    Args:
        client: Of the gateway.
        mailbox: Size of the slave's mailboxes, in place of the master's description.
    """

    def __init__(self, client: GatewayClient, mailbox: int | None = None) -> None:
        self._client = client
        self._mailbox = None if mailbox is None else MailboxSizes(mailbox, mailbox)
        self._slaves: list[MasterSlave] | None = None
        self._reached: set[int] = {MASTER_ADDRESS}
        """Slaves that have answered; a refusal needs no hint then."""

    def scan(self) -> Sequence[Slave]:
        """Return the slaves that the master describes.

        Raises:
            BusError: it does not answer, or has no dictionary.
        """
        try:
            self._slaves = self._client.slaves()
        except NO_DICTIONARY as exc:
            raise BusError(
                f"the gateway does not list its slaves: {exc}; use a station address, such as 1001"
            ) from exc
        return [_slave(each) for each in self._slaves]

    def find(self, name: str) -> Slave:
        """Return the slave with a station address or a name, the master for 0.

        Only a name needs the master: the gateway decides about addresses, and may have virtual
        ones and no dictionary.
        """
        if name in {"0", "master"}:
            return _slave(_unknown(MASTER_ADDRESS, "master"))
        number = slave_number(name)
        if number == ALL_SLAVES:
            raise ConfigError(f"{name} addresses all slaves: name one slave")
        if number < 0:
            return choose(self.scan(), name)
        return _slave(_unknown(number, name))

    def require_mailbox(self, slave: Slave) -> None:
        """Read the mailbox size of *slave*.

        Raises:
            BusError: the master does not describe it.
        """
        if slave.station == MASTER_ADDRESS or self._mailbox is not None:
            return
        reason = "the master does not describe its mailbox size"
        try:
            if self._slaves is None:
                self.scan()
        except BusError as exc:
            reason += f" ({exc.__cause__})"
        if self._description_of(slave) is None:
            raise BusError(
                f"slave {slave.name}: {reason}, and packets of another size would cut a file"
                " off; use --mailbox BYTES"
            )

    def converse(
        self,
        slave: Slave,
        begin: Begin[T],
        name: str,
        meanwhile: Callable[[], None] | None = None,
    ) -> T:
        """Talk to a slave's mailbox, or to the master; return the result or raise."""
        conversation = begin(self._sizes(slave))
        try:
            result = self._client.converse(slave.station, conversation, meanwhile)
        # No hint: only a refusal has a reason that the master may explain.
        except MailboxTimeoutError:
            raise
        except EapError as exc:
            # The mailbox is smaller than assumed, and nothing was done: repeat in smaller parts.
            if _is_too_long(exc) and self._can_learn_size(slave):
                return self.converse(slave, begin, name, meanwhile)
            # A gateway may refuse for a slave that is not there as slaves do for their objects.
            if slave.station not in self._reached and (hint := self._hint(slave, exc)):
                exc.add_note(hint)
            raise
        self._reached.add(slave.station)
        return result

    def bring(self, slaves: Sequence[Slave], target: AlState) -> None:
        """Raise BusError: a gateway has no state requests."""
        del slaves
        _refuse(f"state {target.name}")

    def run(self, procedure: Procedure[T], name: str = "a procedure") -> T:
        """Refuse: a gateway passes mailbox messages, and no datagrams."""
        procedure.close()
        _refuse(name)

    def frame_counts(self) -> FrameCounts:
        """Refuse likewise."""
        _refuse("counters of frames")

    def _sizes(self, slave: Slave) -> MailboxSizes:
        if slave.station == MASTER_ADDRESS:
            return MailboxSizes(_MASTER_SIZE, _MASTER_SIZE)
        if self._mailbox is not None:
            return self._mailbox
        described = self._description_of(slave)
        if described is None:
            return MailboxSizes()
        if not described.to_slave:
            raise no_mailbox(_slave(described), state_name(_slave(described).status.state))
        return MailboxSizes(described.to_slave, described.to_master)

    def _can_learn_size(self, slave: Slave) -> bool:
        """Read the mailbox size of *slave* from the master if it was only assumed."""
        if self._mailbox is not None or self._slaves is not None:
            return False
        with suppress(BusError), self._client.waiting_once(_HINT_S):
            self.scan()
        return self._description_of(slave) is not None

    def _hint(self, slave: Slave, error: EapError) -> str:
        """Return why the mailbox of a slave is unreachable, or where that is shown."""
        self._reached.add(slave.station)  # once is enough
        if _may_mean(error, *_NO_ANSWER):
            return _NO_ANSWER_HINT
        # Other gateways have no mailbox for a slave that is not there.
        if not _may_mean(error, Cause.NO_SLAVE, Cause.NO_MAILBOX):
            return ""
        if self._slaves is None:
            with suppress(BusError), self._client.waiting_once(_HINT_S):
                self.scan()
        if self._slaves is None:
            return ""
        described = self._description_of(slave)
        if described is None:
            known = ", ".join(f"{each.station} ({each.name})" for each in self._slaves) or "none"
            hint = f"address {address_text(slave.station)} is not a slave of this bus ({known})"
            # The master's dictionary has no virtual addresses: the slave may be there all the same.
            is_missing = _may_mean(error, Cause.NO_SLAVE)
            return hint + ("; it may be a virtual address of the plant file" if is_missing else "")
        if not described.to_slave:
            return str(no_mailbox(_slave(described), state_name(_slave(described).status.state)))
        return ""

    def _description_of(self, slave: Slave) -> MasterSlave | None:
        """Return the master's description of a slave, None without one."""
        # With bit 15 set it is the same slave; only the address in the answer differs.
        station = slave.station & ~VIRTUAL_BIT
        return next((each for each in self._slaves or () if each.station == station), None)


def _unknown(station: int, name: str) -> MasterSlave:
    return MasterSlave(station, name, 0, 0, 0, 0, 0, 0, 0)


def _may_mean(error: EapError, *causes: Cause) -> bool:
    """Return whether a gateway of this project reports one of *causes* by *error*."""
    match error:
        case SdoAbortError():
            return error.code in {each.sdo for each in causes}
        case SoeError():
            return error.code in {each.soe for each in causes}
        case FoeError():
            return error.code in {each.foe for each in causes}
        case MailboxRefusedError():
            return error.detail in {each.mailbox for each in causes}
    return False


def _is_too_long(error: EapError) -> bool:
    return (
        (isinstance(error, SdoAbortError) and error.code == AbortCode.LONGER_THAN_MAILBOX)
        or (isinstance(error, MailboxRefusedError) and error.detail == MailboxError.INVALID_SIZE)
        or (isinstance(error, SoeError) and error.code == SoeErrorCode.VALUE_TOO_LONG)
    )


def _slave(slave: MasterSlave) -> Slave:
    return Slave(
        station=slave.station,
        name=slave.name,
        vendor=slave.vendor,
        product=slave.product,
        revision=slave.revision,
        serial=slave.serial,
        alias=0,
        status=AlStatus.decode(slave.al_status.to_bytes(AlStatus.SIZE, "little")),
        protocols=slave.protocols if slave.to_slave else 0,
        parent=None,
        ports=(),
    )


def _refuse(what: str) -> NoReturn:
    raise BusError(f"{what}: a mailbox gateway transfers only mailbox messages")


@contextmanager
def open_gateway(
    host: str, port: int, *, tcp: bool, mailbox: int | None = None
) -> Iterator[GatewayBus]:
    """Talk to a gateway for the length of a block; *mailbox* as GatewayBus has it.

    Raises:
        EnvironmentalError: the host has no address, or accepts no connection.
    """
    with GatewayClient(host, port, tcp=tcp) as client:
        yield GatewayBus(client, mailbox)
