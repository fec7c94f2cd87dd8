"""FoE to a slave of another station: our FoE server, whose files are there (ETG.1000.6)."""

from __future__ import annotations

import asyncio

from devicebus.mailbox.foe_server import FoeServer
from devicebus.mailbox.protocol import MailboxSizes
from eap.aoe.ads_operation import ReadState
from eap.appliance.services.gateway.remote_file import RemoteFile, Wanted
from eap.appliance.services.gateway.remote_link import RemoteLink
from eap.codec.foe import FoeOpcode
from eap.codec.mailbox import MailboxHeader
from eap.gateway.elsewhere import ElsewhereError, reason_for
from eap.gateway.refusal import Reason
from eap.gateway.transfer import is_busy

_DATA, _ERROR = bytes((FoeOpcode.DATA,)), bytes((FoeOpcode.ERROR,))


class RemoteFiles:
    """The files of a slave elsewhere, for one client; a Speaker, and the server's FileStore.

    Args:
        link: Leads to the slave.

    Attributes:
        sizes: Of the slave's mailboxes, as they were when the last file was opened: what fills
            them is not the last packet of a file.
    """

    def __init__(self, link: RemoteLink) -> None:
        self.sizes = MailboxSizes()
        self._link = link
        self._server = FoeServer(self, self.sizes)
        self._file: RemoteFile | None = None

    def reset(self) -> None:
        """Give up the file that is under way."""
        self._server.reset()
        file, self._file = self._file, None
        if file is not None:
            file.close()

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answer to a message: BUSY when it has to wait, and somebody is still there.

        Raises:
            ElsewhereError: what was asked for was refused, or nobody is there.
        """
        if body[:1] == _DATA and len(body) + MailboxHeader.SIZE > self.sizes.to_slave:
            raise ElsewhereError(Reason.TOO_LONG.value.ads)
        # The rest of the time is for the question whether anybody is there.
        end_s = asyncio.get_running_loop().time() + self._link.answer_s / 3
        answers = self._server.receive_message(body, 0)
        while self._file is not None and answers and is_busy(answers[0]):
            try:
                async with asyncio.timeout_at(end_s):
                    await self._file.wait_change()
            except TimeoutError:
                await self._look()
                break
            answers = self._server.receive_message(body, 0)
        if body[:1] == _ERROR:
            self.reset()  # also a file that was not open yet
        return answers

    def open_read(self, name: str, password: int) -> RemoteFile:
        """Open a file for reading."""
        return self._open(Wanted(name, password, is_write=False))

    def open_write(self, name: str, password: int) -> RemoteFile:
        """Open a file for writing from its start."""
        return self._open(Wanted(name, password, is_write=True))

    def _open(self, wanted: Wanted) -> RemoteFile:
        """Return the file when it is open; who asks again for the same waits for the same one."""
        file = self._file
        if file is None or file.is_over or file.wanted != wanted:
            if file is not None:
                file.close()
            file = self._file = RemoteFile(self._link, wanted, self.sizes)
        file.check_open()
        return file

    async def _look(self) -> None:
        """Raise ElsewhereError if nobody answers there: whoever is slow answers this at once."""
        try:
            await self._link.perform(ReadState())
        except ElsewhereError as exc:
            if reason_for(exc.result) is not None:
                raise
