from __future__ import annotations

import pytest

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.protocol import MINIMUM_SIZE, MailboxSizes, refuse
from eap.codec.mailbox import MailboxError


def test_sizes_are_of_whole_mailboxes() -> None:
    sizes = MailboxSizes(256, 128)
    assert (sizes.to_slave, sizes.to_master, sizes.data_to_master) == (256, 128, 122)
    sizes.set(MINIMUM_SIZE, MINIMUM_SIZE)
    assert sizes.data_to_master == 10


@pytest.mark.parametrize("sizes", [(15, 128), (128, 15), (0, 0)])
def test_mailbox_that_is_too_small_is_refused(sizes: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="expected at least 16"):
        MailboxSizes(*sizes)


def test_refusal_carries_the_detail_of_the_standard() -> None:
    with pytest.raises(MailboxRefusedError, match="INVALID_HEADER: no length") as caught:
        refuse(MailboxError.INVALID_HEADER, "no length")
    assert caught.value.detail == 5
