"""Many messages in one system call: ``recvmmsg`` and ``sendmmsg`` through ctypes.

This is the hottest code of the drivers, so everything possible is computed before the call.  The
arrays that the kernel reads are built once and their addresses are bound into the call, because
ctypes takes longer to convert five arguments than the kernel takes to find an empty queue.
"""

from __future__ import annotations

import ctypes
import errno
import socket
import struct
from collections.abc import Callable, Sequence
from functools import partial
from time import monotonic_ns, time_ns
from typing import Any

from eap.compiled import cyclic
from eap.pd.link import OutFrame

ICMP_ERRNOS = frozenset(
    {
        errno.ECONNREFUSED,
        errno.EHOSTUNREACH,
        errno.ENETUNREACH,
        errno.EHOSTDOWN,
        errno.ENOPROTOOPT,
        errno.EPROTO,
        errno.EMSGSIZE,
        errno.EACCES,
    }
)
"""Errors of a call caused by an earlier datagram; some also have a cause of their own."""

SO_TIMESTAMPNS = 35
"""Missing in the socket module; the same number on every Linux with 64-bit time."""

BATCH = 64
BUFFER_SIZE = 2112
"""An Ethernet header, the largest frame that an 11-bit Length can announce, and some air."""
STAMP_SIZE = 32
"""Bytes of control data that a time stamp takes."""

_MMSGHDR = struct.Struct("@QQQQQQQQ")  # name, namelen, iov, iovlen, control, controllen, flags, len
_IOVEC = struct.Struct("@QQ")
_CACHED_BATCHES = 256
_CACHED_FRAMES = 4096
_CACHED_ADDRESSES = 1024
_SOCKADDR_SIZE = 16  # of IPv4
_SENDER = struct.Struct("!2xH4s8x").unpack_from
_CLOCK_NOISE_NS = 1000

_library = ctypes.CDLL(None, use_errno=True)
_recvmmsg = _library["recvmmsg"]
_sendmmsg = _library["sendmmsg"]


def _address(memory: bytearray) -> int:
    return ctypes.addressof(ctypes.c_char.from_buffer(memory))


def count_error(errors: dict[str, int], number: int | None) -> None:
    """Count a failed call under the name of its errno, such as ``ENETDOWN``."""
    name = errno.errorcode.get(number or 0, str(number))
    errors[name] = errors.get(name, 0) + 1


def note_receive_error(errors: dict[str, int], number: int | None = None) -> bool:
    """Count why the last receive call returned -1, unless there was just nothing to receive.

    *number* is the errno of a call that was not made by :meth:`ReceiveBatch.reader`.  Return True
    if the error belongs to an earlier datagram: then messages may still be waiting.
    """
    if number is None:
        number = ctypes.get_errno()
    if number in ICMP_ERRNOS:
        return True
    if number not in (errno.EAGAIN, errno.EINTR):
        count_error(errors, number)
    return False


class ReceiveBatch:
    """The memory of one ``recvmmsg`` call, shared by all sockets of a process.

    *control_size* must be exactly what the kernel writes for one message, the time stamp first:
    then it leaves every header as it was and nothing needs to be set up again.

    The same holds for the addresses of the senders, which are kept when *with_senders*.

    Attributes:
        views: The messages, each from behind *headroom* bytes to the end of its memory.
        octets: All of that memory, BUFFER_SIZE for each message.
        control: All control data, *control_size* for each message.
    """

    def __init__(
        self, control_size: int = STAMP_SIZE, headroom: int = 0, *, with_senders: bool = True
    ) -> None:
        self._control_size = control_size
        self._headroom = headroom
        self._with_senders = with_senders
        self._compiled: Any = None
        self._buffers = bytearray(BATCH * BUFFER_SIZE)
        self._control = bytearray(BATCH * control_size)
        self._senders = bytearray(BATCH * _SOCKADDR_SIZE)
        iovecs = bytearray(BATCH * _IOVEC.size)
        self._headers = bytearray(BATCH * _MMSGHDR.size)
        buffers, control, vectors, senders = map(
            _address, (self._buffers, self._control, iovecs, self._senders)
        )
        name_size = _SOCKADDR_SIZE if with_senders else 0
        for n in range(BATCH):
            _IOVEC.pack_into(iovecs, n * _IOVEC.size, buffers + n * BUFFER_SIZE, BUFFER_SIZE)
            vector = vectors + n * _IOVEC.size
            place = control + n * control_size
            name = senders + n * _SOCKADDR_SIZE if with_senders else 0
            header = (name, name_size, vector, 1, place, control_size, 0, 0)
            _MMSGHDR.pack_into(self._headers, n * _MMSGHDR.size, *header)
        self._iovecs = iovecs  # the kernel reads it through the headers
        self._words = memoryview(self._headers).cast("Q")
        self._stamps = memoryview(self._control).cast("q")
        self._stride = control_size // 8
        self._offset = monotonic_ns() - time_ns()
        self.control = memoryview(self._control)
        self.octets = memoryview(self._buffers)
        self.views = [
            self.octets[n * BUFFER_SIZE + headroom : (n + 1) * BUFFER_SIZE] for n in range(BATCH)
        ]
        # By identity: a view of a writable buffer has no hash, and comparing two compares octets.
        self._positions = {id(view): n for n, view in enumerate(self.views)}

    def reader(self, fd: int) -> Callable[[], int]:
        """Return the call that fills the batch from *fd* and returns how many came, or -1."""
        headers = ctypes.c_void_p(_address(self._headers))
        return partial(_recvmmsg, fd, headers, BATCH, socket.MSG_DONTWAIT, None)

    def compiled_socket(
        self, fd: int, handlers: object, origin: object, sender: SendBatch | None
    ) -> Any:
        """Return what drains a socket into this memory; None without compiled part.

        It does what the channels of this package do by :meth:`reader`, and calls compiled handlers
        without a detour.  The cycle of a station sends through it.

        Args:
            fd: Of the socket.
            handlers: A list, or those of an Ethernet interface by VLAN and address.
            origin: Its ``note_error`` is called for errors, its ``count_unrouted`` for frames
                without handlers, and its ``drain`` in place of all that unless ``may_drain`` of
                the result is true.
            sender: What goes on where the kernel did not take a frame.  It is not used unless
                ``may_send`` of the result is true.
        """
        if cyclic is None:
            return None
        if self._compiled is None:
            self._compiled = cyclic.Receiver(
                self.octets,
                self._control,
                self._senders if self._with_senders else None,
                self._control_size,
                self._headroom,
                self.views,
            )
        return cyclic.Socket(self._compiled, fd, handlers, origin, sender)

    def arrival(self) -> tuple[memoryview, int, int]:
        """Return view, whole size and monotonic arrival time of the only message of a batch."""
        now_ns = self._read_clocks()
        words, stamps = self._words, self._stamps
        # The kernel writes the length that it used: a message without a stamp shortens the header
        # for all that follow in that place.
        if words[5] != self._control_size:
            words[5] = self._control_size
            return self.views[0], words[7], now_ns
        at_ns = stamps[2] * 1_000_000_000 + stamps[3] + self._offset
        if at_ns > now_ns:  # noqa: PLR1730  the wall clock was set back; min() takes longer
            at_ns = now_ns
        return self.views[0], words[7], at_ns

    def arrivals(self, count: int) -> tuple[list[int], list[int]]:
        """Return the whole sizes and the monotonic arrival times of the first *count* messages."""
        now_ns = self._read_clocks()
        words = self._words
        times = self._times(count, self._offset)
        if words[5 : count * 8 : 8].tolist().count(self._control_size) != count:
            times = self._mend(times, now_ns)
        if times[0] > now_ns:  # the wall clock was set back since
            times = [now_ns] * count
        return words[7 : count * 8 : 8].tolist(), times

    def position(self, view: memoryview) -> int | None:
        """Return which message of the batch *view* is, None if it is no view of this batch."""
        return self._positions.get(id(view))

    def sender(self, view: memoryview) -> tuple[int, bytes]:
        """Return port and IPv4 address of the sender of *view*, as long as the batch holds it."""
        port, address = _SENDER(self._senders, self._positions[id(view)] * _SOCKADDR_SIZE)
        return port, address

    def source_reader(self) -> Callable[[memoryview], bytes]:
        """Return the function that gives the source IPv4 address of a view of the batch.

        It is called for each frame; half its time would be attributes of this object.
        """
        senders, read = self._senders, _SENDER
        offsets = {key: n * _SOCKADDR_SIZE for key, n in self._positions.items()}

        def source(view: memoryview) -> bytes:
            octets: bytes = read(senders, offsets[id(view)])[1]
            return octets

        return source

    def _read_clocks(self) -> int:
        """Return the monotonic time and see how far the wall clock, which stamps, is from it.

        The distance changes only when the wall clock is set.  An interruption between the two
        readings makes it look smaller: a smaller distance is accepted only if measured again.
        """
        now_ns = monotonic_ns()
        # SO_TIMESTAMPNS has the wall clock only, while deadlines here are monotonic.
        offset = now_ns - time_ns()
        if offset > self._offset:
            self._offset = offset
        elif offset < self._offset - _CLOCK_NOISE_NS:
            self._offset = max(offset, *(monotonic_ns() - time_ns() for _ in range(3)))
        return now_ns

    def _times(self, count: int, offset: int) -> list[int]:
        stride = self._stride
        seconds = self._stamps[2 : count * stride : stride].tolist()
        nanoseconds = self._stamps[3 : count * stride : stride].tolist()
        first = seconds[0]
        if seconds.count(first) == count:
            base = first * 1_000_000_000 + offset
            return [base + rest for rest in nanoseconds]
        return [
            whole * 1_000_000_000 + rest + offset
            for whole, rest in zip(seconds, nanoseconds, strict=True)
        ]

    def _mend(self, times: list[int], now_ns: int) -> list[int]:
        """Replace the time of messages that came without a stamp, and restore their headers."""
        for n in range(len(times)):
            if self._words[n * 8 + 5] != self._control_size:
                times[n] = now_ns
                self._words[n * 8 + 5] = self._control_size
        return times


class SendBatch:
    """Sends frames through one socket, several in one call, and never blocks or raises.

    *address_of* gives the packed socket address and the Python one of a destination; without it
    the socket itself knows where frames go.
    """

    def __init__(
        self,
        sock: socket.socket,
        address_of: Callable[[str], tuple[bytes, tuple[str, int]]] | None = None,
    ) -> None:
        self.errors: dict[str, int] = {}
        self._sock = sock
        self._send_octets = sock.send
        self._fd = sock.fileno()
        self._address_of = address_of
        self._addresses: dict[str, tuple[bytearray, tuple[str, int]]] = {}
        self._headers: dict[OutFrame, tuple[bytes, bytearray, bytearray]] = {}
        self._batches: dict[tuple[OutFrame, ...], tuple[Callable[[], int], bytearray]] = {}

    def send(self, frames: Sequence[OutFrame]) -> Sequence[OutFrame]:
        """Send *frames*; return those that the kernel rejected, counted in :attr:`errors`."""
        if len(frames) == 1:
            # For one frame the socket's own method is faster than anything through ctypes.
            frame = frames[0]
            try:
                if self._address_of is None:
                    self._send_octets(frame.buffer)
                else:
                    known = self._addresses.get(frame.destination)
                    known = known or self._resolve(frame.destination)
                    self._sock.sendto(frame.buffer, known[1])
            except OSError as error:
                if error.errno in ICMP_ERRNOS:  # it may be about another frame, sent before
                    return self._send_many(frames)
                self._fail(frame, error.errno)
                return frames
            return ()
        return self._send_many(frames) if frames else ()

    def _send_many(self, frames: Sequence[OutFrame]) -> Sequence[OutFrame]:
        key = tuple(frames)
        sent = (self._batches.get(key) or self._prepare(key))[0]()
        return () if sent == len(key) else self.go_on(key, sent, ctypes.get_errno())

    def go_on(self, frames: Sequence[OutFrame], sent: int, number: int) -> list[OutFrame]:
        """Continue behind the first *sent* frames; each frame that fails is skipped.

        *number* is the errno of a call that sent none and returned -1.
        """
        key = tuple(frames)
        _, headers = self._batches.get(key) or self._prepare(key)
        failed: list[OutFrame] = []
        done = 0
        tried_again = -1
        while True:
            # An ICMP error belongs to an earlier datagram: the call is made once more.
            if sent < 0 and number in ICMP_ERRNOS and tried_again != done:
                tried_again, sent = done, 0
            elif sent < 0:
                self._fail(frames[done], number)
                failed.append(frames[done])
                sent = 1
            done += sent
            if done >= len(frames):
                return failed
            sent = self._call(headers, done)()
            number = ctypes.get_errno()

    def address_of(self, frame: OutFrame) -> bytes:
        """Return the packed socket address of *frame*; nothing if the socket knows it."""
        if self._address_of is None:
            return b""
        known = self._addresses.get(frame.destination) or self._resolve(frame.destination)
        return bytes(known[0])

    def _fail(self, frame: OutFrame, number: int | None) -> None:
        frame.oversized = number == errno.EMSGSIZE
        count_error(self.errors, number)

    def _call(self, headers: bytearray, first: int) -> Callable[[], int]:
        place = ctypes.c_void_p(_address(headers) + first * _MMSGHDR.size)
        count = len(headers) // _MMSGHDR.size - first
        return partial(_sendmmsg, self._fd, place, count, socket.MSG_DONTWAIT)

    def _prepare(self, frames: tuple[OutFrame, ...]) -> tuple[Callable[[], int], bytearray]:
        known = self._headers
        # Cleared as a whole: which frames are still in use is not known here, and refilling is
        # cheap.
        if len(self._batches) >= _CACHED_BATCHES or len(known) >= _CACHED_FRAMES:
            # Together: a batch points into the descriptions of its frames.
            self._batches.clear()
            known.clear()
        headers = bytearray().join(
            (known.get(frame) or self._describe(frame))[0] for frame in frames
        )
        batch = self._batches[frames] = self._call(headers, 0), headers
        return batch

    def _describe(self, frame: OutFrame) -> tuple[bytes, bytearray, bytearray]:
        """Return the kernel's description of *frame*; it holds for the life of the frame."""
        address = bytearray()
        if self._address_of is not None:
            known = self._addresses.get(frame.destination) or self._resolve(frame.destination)
            address = known[0]
        name = _address(address) if address else 0
        iovec = bytearray(_IOVEC.pack(_address(frame.buffer), len(frame.buffer)))
        header = _MMSGHDR.pack(name, len(address), _address(iovec), 1, 0, 0, 0, 0)
        described = self._headers[frame] = header, iovec, address
        return described

    def _resolve(self, destination: str) -> tuple[bytearray, tuple[str, int]]:
        assert self._address_of is not None  # noqa: S101  the callers asked
        if len(self._addresses) >= _CACHED_ADDRESSES:
            self._addresses.clear()  # requesters may forge any number of them
        packed, address = self._address_of(destination)
        known = self._addresses[destination] = bytearray(packed), address
        return known
