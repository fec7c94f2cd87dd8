"""Downloads as a tool makes them, in short."""

from __future__ import annotations

from typing import Any

from eap.device.configuration import adopt_configuration
from eap.device.eap_dictionary import EapDictionary
from eap.od.abort import SdoAbortError
from eap.od.model import OdState
from eap.od.profiles.eap1000 import AddressMode, FrameSub, Rx, RxFlag, Tx, Var, row_of

PREOP, SAFEOP, OP = OdState.PREOP, OdState.SAFEOP, OdState.OP


def write(
    dictionary: EapDictionary, index: int, subindex: int, value: Any, state: OdState = PREOP
) -> None:
    """Download a value; bytes go as they are, texts as UTF-8, numbers as wide as the entry is."""
    if isinstance(value, str):
        data = value.encode()
    elif isinstance(value, bytes):
        data = value
    else:
        data = int(value).to_bytes(width(index, subindex, dictionary), "little")
    dictionary.download(index, subindex, data, state)


def copy(dictionary: EapDictionary) -> EapDictionary:
    """Return another dictionary with the same configuration, for which nothing runs."""
    other = dictionary.blank()
    adopt_configuration(other, dictionary)
    return other


def width(index: int, subindex: int, dictionary: EapDictionary) -> int:
    """Return the octets of an entry, which need not be there yet."""
    try:
        return dictionary.entry(index, subindex).kind.size
    except SdoAbortError:
        row = row_of(index)
        fresh = dictionary.make_object(row, index, last=row.last_subindex if row.list_row else 0)
        return fresh.entries[subindex].kind.size


def variable(dictionary: EapDictionary, index: int, name: str, kind: str = "UINT") -> int:
    """Make a variable and return its index."""
    write(dictionary, index, Var.NAME, name)
    write(dictionary, index, Var.TYPE_NAME, kind)
    return index


def mapping(dictionary: EapDictionary, index: int, *mapped: tuple[int, int]) -> int:
    """Write a mapping of *mapped* (index, bits) whole."""
    write(dictionary, index, 0, 0)
    for subindex, (target, bits) in enumerate(mapped, 1):
        write(dictionary, index, subindex, target << 16 | (1 << 8 if target else 0) | bits)
    write(dictionary, index, 0, len(mapped))
    return index


def tx_pd(dictionary: EapDictionary, index: int, pdo: int, pd_id: int) -> int:
    """Make an enabled TxPD."""
    write(dictionary, index, Tx.PDO_INDEX, pdo)
    write(dictionary, index, Tx.PD_ID, pd_id)
    write(dictionary, index, Tx.ENABLED, 1)
    return index


def rx_pd(dictionary: EapDictionary, index: int, pdo: int, pd_id: int) -> int:
    """Make an enabled RxPD of any publisher."""
    write(dictionary, index, Rx.PDO_INDEX, pdo)
    write(dictionary, index, Rx.PD_ID, pd_id)
    write(dictionary, index, Rx.FLAGS, RxFlag.ENABLED)
    return index


def frame(dictionary: EapDictionary, index: int, *pds: int, to: bytes = b"\x0a\0\0\2") -> int:
    """Make an enabled frame to an IPv4 address, or to a MAC address of six octets."""
    is_mac = len(to) == 6
    write(dictionary, index, FrameSub.ADDRESS_MODE, AddressMode.MAC if is_mac else AddressMode.IP)
    write(dictionary, index, FrameSub.DESTINATION_MAC if is_mac else FrameSub.DESTINATION_IP, to)
    for subindex, pd in enumerate(pds, FrameSub.TXPD):
        write(dictionary, index, subindex, pd)
    write(dictionary, index, FrameSub.ENABLED, 1)
    return index


def sender(dictionary: EapDictionary) -> EapDictionary:
    """Make the smallest configuration that sends: 6000, 1A00, D000, 8000."""
    mapping(dictionary, 0x1A00, (variable(dictionary, 0x6000, "level"), 16))
    frame(dictionary, 0x8000, tx_pd(dictionary, 0xD000, 0x1A00, 1))
    return dictionary


def receiver(dictionary: EapDictionary) -> EapDictionary:
    """Make the smallest configuration that receives: 7000, 1600, E000."""
    mapping(dictionary, 0x1600, (variable(dictionary, 0x7000, "limit"), 16))
    rx_pd(dictionary, 0xE000, 0x1600, 1)
    return dictionary
