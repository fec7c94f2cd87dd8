# Compiled part of the cyclic path; built from eap/_cyclic.c where a compiler is.

from collections.abc import Callable, Mapping, Sequence
from typing import Self

API: int
OFFSETS: tuple[int, ...]

# The plan of one layout of frames: bytes of the frame; headers of all PDs, six bytes each; trackers
# with their copies as eap/pd/compiledplan.py packs them; indexes of the words to add one to; an
# object whose `source` is the address that the frames come from.
class Plan:
    def __new__(
        cls, end: int, headers: bytes, parts: bytes, counters: bytes, watch: object, /
    ) -> Self: ...

# Handler of the frames of one port.  It leaves to *fallback* what is not usual, and everything as
# long as the `wanted` of *learner*, which may be None, is not empty.
class PortHandler:
    # Frames that arrived earlier are left to *fallback*.
    open_from_ns: int
    def __new__(cls, fallback: Callable[..., object], learner: object, /) -> Self: ...
    def __call__(self, data: memoryview, size: int, at_ns: int, origin: object, /) -> None: ...
    # Look for plans in *plans* from now on, and write to *memory* and *words*.
    def attach(
        self, plans: Mapping[object, object], memory: memoryview, words: memoryview, /
    ) -> None: ...
    # Let go of everything; frames are ignored from now on.
    def detach(self) -> None: ...

# Messages of recvmmsg for handlers; arguments are the parts of a ReceiveBatch.
class Receiver:
    def __new__(
        cls,
        headers: bytearray,
        octets: memoryview,
        control: bytearray,
        senders: bytearray | None,
        control_size: int,
        headroom: int,
        views: Sequence[memoryview],
        /,
    ) -> Self: ...
    # Hand all waiting messages over, at most four batches; return how many had a handler.  With
    # *unrouted*, *handlers* has those of each VLAN and address, and *unrouted* is called with the
    # position of each other frame.  *note_error* gets an errno; True if messages may still wait.
    def drain(
        self,
        fd: int,
        handlers: Sequence[object] | Mapping[int, Mapping[int, Sequence[object]]],
        unrouted: Callable[[int], object] | None,
        origin: object,
        note_error: Callable[[int], bool],
        /,
    ) -> int: ...
