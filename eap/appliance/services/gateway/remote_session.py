"""One client's session with a slave of another station, in one mailbox protocol.

What goes to the other station is a whole SDO, IDN or block of a file, by AoE; a *speaker* knows one
protocol, and puts together or takes apart what its messages carry.
"""

from __future__ import annotations

import asyncio
from typing import Protocol

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.protocol import MailboxSizes
from eap.appliance.services.gateway.remote_ads import RemoteAds
from eap.appliance.services.gateway.remote_files import RemoteFiles
from eap.appliance.services.gateway.remote_idns import RemoteIdns, RemoteVendor
from eap.appliance.services.gateway.remote_link import RemoteLink
from eap.appliance.services.gateway.remote_objects import RemoteObjects
from eap.appliance.services.gateway.slave_session import IDLE_S, NoTurnError, Reply, again, turn_of
from eap.codec.mailbox import MailboxType
from eap.errors import CodecError, TruncatedError
from eap.gateway.elsewhere import ElsewhereError, reason_for, refusal_for
from eap.gateway.refusal import Reason, mailbox_error, refuse
from eap.gateway.transfer import Transfer


class Speaker(Protocol):
    """One mailbox protocol of a slave elsewhere, for one client.

    Attributes:
        sizes: Of mailboxes, as the client is to know them.
    """

    sizes: MailboxSizes

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answers to a message.

        Raises:
            ElsewhereError: it was refused there.
            MailboxRefusedError: it can only be answered with a mailbox error.
            CodecError: it is cut, or none of this protocol.
        """

    def reset(self) -> None:
        """End what is under way."""


class RemoteSession:
    """What one client does with one slave elsewhere.

    Args:
        kind: The protocol.
        link: Leads to the slave.
        room: Octets of the longest answer behind its mailbox header.
        idle_s: How long a transfer waits for its client's next step.
    """

    def __init__(
        self, kind: MailboxType, link: RemoteLink, *, room: int, idle_s: float = IDLE_S
    ) -> None:
        self._kind = kind
        self._answer_s = link.answer_s
        self._idle_s = idle_s
        sizes = MailboxSizes.of_data(room)
        self._speaker = _speaker(kind, link, sizes)
        self._transfer = Transfer(kind, self._speaker.sizes if self._speaker else sizes)
        self._last: list[Reply] = []
        self._turn = asyncio.Lock()
        self._timer: asyncio.TimerHandle | None = None

    @property
    def is_running(self) -> bool:
        """Whether a transfer is under way."""
        return self._transfer.is_running

    async def ask(self, body: bytes) -> list[Reply]:
        """Return the answers to a request, which may be none."""
        deadline_s = asyncio.get_running_loop().time() + self._answer_s
        try:
            async with turn_of(self._turn, deadline_s):
                return await self._ask(body, deadline_s)
        except NoTurnError:
            return self._refuse(body, Reason.TIMEOUT)

    async def _ask(self, body: bytes, deadline_s: float) -> list[Reply]:
        if self._transfer.is_repeated(body):
            return again(self._last)
        self._stop_timer()
        self._transfer.ask(body)
        self._last = await self._answer(body, deadline_s)
        for reply in self._last:
            self._transfer.answer(reply.body)
        if self.is_running:
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(self._idle_s, self.close)
        return self._last

    def close(self) -> None:
        """End what is under way."""
        self._stop_timer()
        if self._speaker is not None:
            self._speaker.reset()
        self._transfer.end()

    async def _answer(self, body: bytes, deadline_s: float) -> list[Reply]:
        if self._speaker is None:
            return self._refuse(body, Reason.NO_PROTOCOL)
        try:
            async with asyncio.timeout_at(deadline_s):
                answers = await self._speaker.answer(body)
        except TimeoutError:
            self.close()
            return self._refuse(body, Reason.TIMEOUT)
        except MailboxRefusedError as exc:
            return [Reply(*mailbox_error(exc.detail))]
        except CodecError as exc:
            is_cut = isinstance(exc, TruncatedError)
            return self._refuse(body, Reason.TOO_SHORT if is_cut else Reason.SERVICE)
        except ElsewhereError as exc:
            self.close()
            return self._tell(body, exc.result)
        return [Reply(self._kind, answer) for answer in answers]

    def _tell(self, body: bytes, result: int) -> list[Reply]:
        """Say in the protocol of a request why it was refused."""
        reason = reason_for(result)
        if reason is not None:
            return self._refuse(body, reason)
        answer = refusal_for(self._kind, body, result)
        if answer is None:
            return self._refuse(body, Reason.SERVICE)
        return [Reply(self._kind, answer)]

    def _refuse(self, body: bytes, reason: Reason) -> list[Reply]:
        return [Reply(*refuse(self._kind, body, reason), reason=reason)]

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def _speaker(kind: MailboxType, link: RemoteLink, sizes: MailboxSizes) -> Speaker | None:
    match kind:
        case MailboxType.COE:
            return RemoteObjects(link, sizes)
        case MailboxType.SOE:
            return RemoteIdns(link, sizes)
        case MailboxType.FOE:
            return RemoteFiles(link)
        case MailboxType.VOE:
            return RemoteVendor(link)
        case MailboxType.AOE:
            return RemoteAds(link, sizes)
    return None  # EoE: no service of ADS takes Ethernet frames
