"""The system service behind port 10000: what clients look at before they talk to anybody else.

ReadState and ReadDeviceInfo are those of every device; beside them stands the group that the open
client ads-client reads when it connects.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

from eap.ads.operation import AdsRefusedError
from eap.ads.space import AdsSpace
from eap.codec.ads import AdsError, AdsSystemState, IndexGroup


class SystemSpace(AdsSpace):
    """The state of the whole station; *state* is called whenever somebody asks."""

    groups: Collection[int] = frozenset((IndexGroup.SYSTEM_STATE,))

    def __init__(self, state: Callable[[], AdsSystemState]) -> None:
        self._state = state

    def read(self, group: int, offset: int, length: int) -> bytes:
        """Return the state, cut to *length*."""
        del group
        if offset:
            raise AdsRefusedError(AdsError.INDEX_OFFSET)
        return self._state().encode()[:length]
