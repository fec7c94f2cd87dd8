"""Process data of drives with SoE: the telegrams AT and MDT (IEC 61800-7-300).

PDO 24 is the MDT of the first drive and PDO 16 its AT, 0x1018 and 0x1010 are those of the second,
and so on; an entry is an IDN.  The lists S-0-0024 and S-0-0016 choose the IDNs behind master
control word and drive status word, which are always there and not in the lists.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from devicebus.errors import SoeError
from devicebus.mailbox import soe_client
from devicebus.mailbox.conversation import Conversation, reading
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.master.pdo import Pdo, PdoEntry, ProcessDataChannel
from eap.codec.soe import (
    AT,
    CONTROL_WORD,
    MDT,
    STATUS_WORD,
    Element,
    Idn,
    SoeAttribute,
    SoeErrorCode,
    encode_list,
)
from eap.od.slave_config import MappedObject

_WORDS = (CONTROL_WORD, STATUS_WORD)
_WORD_BITS = 16
_DRIVE_SHIFT = 12
_NUMBER = (1 << _DRIVE_SHIFT) - 1


def write_lists(
    mapping: Mapping[int, Sequence[MappedObject]], sizes: MailboxSizes
) -> Conversation[None]:
    """Write the lists of the telegrams in a PDO mapping.

    Raises SoeError if the drive refuses a list.
    """
    for pdo, entries in mapping.items():
        if (number := pdo & _NUMBER) in {AT, MDT}:
            idns = [each.index for each in entries if each.index not in _WORDS]
            octets = b"".join(idn.to_bytes(2, "little") for idn in idns)
            yield from soe_client.write(
                Idn.of(number), encode_list(octets), sizes, drive=pdo >> _DRIVE_SHIFT
            )


def read_telegrams(
    channels: Sequence[ProcessDataChannel],
) -> Conversation[tuple[ProcessDataChannel, ...]]:
    """Return *channels*, as the EEPROM has them, with the IDNs that the drives transfer.

    A sync manager without PDOs has the telegram of the first drive; a telegram whose list the drive
    does not have is that of the EEPROM.

    Raises MailboxProtocolError if an answer is invalid.
    """
    found = []
    for channel in channels:
        pdos: Sequence[Pdo] = channel.pdos
        if not pdos:
            number, word = (MDT, CONTROL_WORD) if channel.is_output else (AT, STATUS_WORD)
            pdos = (Pdo(number, (PdoEntry(word, 0, _WORD_BITS),)),)
        telegrams = []
        is_read = False
        for pdo in pdos:
            telegram = (
                (yield from _read_telegram(pdo)) if pdo.index & _NUMBER in {AT, MDT} else None
            )
            is_read |= telegram is not None
            telegrams.append(telegram or pdo)
        found.append(channel._replace(pdos=tuple(telegrams)) if is_read else channel)
    return tuple(found)


def _read_telegram(pdo: Pdo) -> Conversation[Pdo | None]:
    """Return a telegram with the IDNs of its list; None if the drive has no list."""
    drive = pdo.index >> _DRIVE_SHIFT
    try:
        idns = yield from soe_client.idn_list(Idn.of(pdo.index & _NUMBER), drive=drive)
    except SoeError as exc:
        if exc.code == SoeErrorCode.NO_IDN:
            return None
        raise
    known = {entry.index: entry for entry in pdo.entries}
    entries = list(_words_of(pdo))
    for idn in idns:
        if idn.number in _WORDS:
            continue  # as the first entry, whether the list has it or not
        entry = known.get(idn.number)
        if entry is None:
            octets = yield from soe_client.read(idn, Element.ATTRIBUTE, drive=drive)
            with reading(f"attribute of {idn}"):
                attribute = SoeAttribute.decode(octets)
            entry = PdoEntry(idn.number, 0, 8 << attribute.length)
        entries.append(entry)
    return Pdo(pdo.index, tuple(entries))


def _words_of(pdo: Pdo) -> Iterator[PdoEntry]:
    return (entry for entry in pdo.entries if entry.index in _WORDS)
