"""Records of a vendor's device description (ETG.2000), without behaviour of a simulator or master.

Numbers of PDOs, sync managers and sizes are those of the file; nothing is completed.
"""

from __future__ import annotations

from enum import StrEnum

import msgspec

from eap.od.model import RW, Access
from eap.od.slave_config import OpMode, RevisionRule, StateTimeouts


class SmUse(StrEnum):
    """Use of a sync manager, the text of element Sm."""

    MAILBOX_OUT = "MBoxOut"
    MAILBOX_IN = "MBoxIn"
    OUTPUTS = "Outputs"
    INPUTS = "Inputs"
    DYNAMIC_OUTPUTS = "DynamicOutputs"
    DYNAMIC_INPUTS = "DynamicInputs"


class EsiSyncManager(msgspec.Struct, frozen=True, kw_only=True):
    """Element Sm."""

    use: SmUse
    start: int = 0
    default_size: int | None = None
    """None: the length is that of the assigned PDOs."""
    min_size: int | None = None
    max_size: int | None = None
    control: int | None = None
    is_enabled: bool = True
    is_virtual: bool = False
    """True if the FMMU maps registers and no sync manager is set up."""
    op_only: bool = False

    @property
    def is_output(self) -> bool:
        """True if the master writes it."""
        return self.use in {SmUse.MAILBOX_OUT, SmUse.OUTPUTS, SmUse.DYNAMIC_OUTPUTS}

    @property
    def is_mailbox(self) -> bool:
        """True for the two mailboxes."""
        return self.use in {SmUse.MAILBOX_OUT, SmUse.MAILBOX_IN}


class EsiFmmu(msgspec.Struct, frozen=True):
    """Element Fmmu: Outputs, Inputs, MBoxState, or one of the dynamic ones."""

    use: str
    sync_manager: int | None = None
    op_only: bool = False


class EsiPdoEntry(msgspec.Struct, frozen=True, kw_only=True):
    """Element Entry of a PDO; index 0 is padding, with SoE the index is an IDN."""

    index: int
    subindex: int = 0
    bits: int = 0
    name: str = ""
    type: str = ""
    is_fixed: bool = False
    depends_on_slot: bool = False


class EsiPdo(msgspec.Struct, frozen=True, kw_only=True):
    """Element RxPdo (an output) or TxPdo."""

    index: int
    name: str
    is_output: bool
    entries: tuple[EsiPdoEntry, ...] = ()
    sync_manager: int | None = None
    """Sync manager that has it by default; None: it is optional."""
    is_fixed: bool = False
    """True if its mapping cannot be changed."""
    is_mandatory: bool = False
    is_virtual: bool = False
    excludes: tuple[int, ...] = ()
    """PDOs that cannot be assigned together with it."""
    depends_on_slot: bool = False
    overwritten_by_module: bool = False
    line: int = 0

    @property
    def drive(self) -> int:
        """Drive whose telegram it is, with SoE."""
        # PDO 24 is the MDT of the first drive, 0x1018 that of the second (ETG.1000.6).
        return self.index >> 12

    @property
    def bits(self) -> int:
        """Sum of the bits of all entries."""
        return sum(entry.bits for entry in self.entries)


class EsiInitCommand(msgspec.Struct, frozen=True, kw_only=True):
    """Element InitCmd of CoE or SoE: a write at transitions such as IP and PS."""

    transitions: tuple[str, ...]
    index: int
    """Index of an object, or number of an IDN."""
    data: bytes
    subindex: int = 0
    channel: int = 0
    """Drive, with SoE."""
    is_soe: bool = False
    complete_access: bool = False
    is_fixed: bool = False
    is_adapted: bool = False
    """True if TwinCAT adapts the data to the configuration (AdaptAutomatically)."""
    overwritten_by_module: bool = False
    depends_on_slot: bool = False
    comment: str = ""


class EsiCoe(msgspec.Struct, frozen=True, kw_only=True):
    """Attributes of Mailbox/CoE."""

    sdo_info: bool = False
    pdo_assign: bool = False
    pdo_config: bool = False
    pdo_upload: bool = False
    complete_access: bool = False
    segmented_sdo: bool = True
    diagnosis_history: bool = False


class EsiMailbox(msgspec.Struct, frozen=True, kw_only=True):
    """Element Mailbox."""

    coe: EsiCoe | None = None
    soe_channels: int = 0
    """Drives with SoE; 0 without SoE."""
    aoe: bool = False
    eoe: bool = False
    foe: bool = False
    voe: bool = False
    has_link_layer: bool = False


class EsiOpMode(msgspec.Struct, frozen=True, kw_only=True):
    """Element Dc/OpMode."""

    mode: OpMode
    description: str = ""


class EsiEeprom(msgspec.Struct, frozen=True, kw_only=True):
    """Element Eeprom."""

    byte_size: int = 0
    config_data: bytes = b""
    bootstrap: bytes = b""
    image: bytes = b""
    """Whole image (element Data), which replaces all others."""
    categories: tuple[tuple[int, bytes], ...] = ()


class EsiAlternative(msgspec.Struct, frozen=True, kw_only=True):
    """VendorSpecific/TwinCAT/AlternativeSmMapping: a named PDO assignment."""

    name: str
    is_default: bool = False
    sync_managers: tuple[tuple[int, tuple[int, ...]], ...] = ()
    """PDOs by sync manager."""


class EsiValue(msgspec.Struct, frozen=True, kw_only=True):
    """Entry of an object.

    Not an EntrySpec of a bus file: that has a value as a user writes it, with limits, whereas a
    vendor gives the encoded initial value.
    """

    subindex: int
    name: str
    type: str
    """For ``datatypes.parse``, with the length of the file."""
    access: Access = RW
    default: bytes | None = None
    """Encoded initial value; None without one."""


class EsiObject(msgspec.Struct, frozen=True, kw_only=True):
    """Element Object: a variable with one entry 0, or a record without its entry 0."""

    index: int
    name: str
    entries: tuple[EsiValue, ...]
    is_record: bool = False


class EsiModule(msgspec.Struct, frozen=True, kw_only=True):
    """Element Module: part of a device in a slot."""

    ident: int
    type: str
    name: str = ""
    module_class: str = ""
    pdos: tuple[EsiPdo, ...] = ()
    init_commands: tuple[EsiInitCommand, ...] = ()
    objects: tuple[EsiObject, ...] = ()


class EsiSlot(msgspec.Struct, frozen=True, kw_only=True):
    """Element Slot: modules that fit, by ident or class."""

    name: str = ""
    idents: tuple[int, ...] = ()
    classes: tuple[str, ...] = ()
    default: int | None = None
    """Ident of the module that is there by default."""
    min_instances: int = 0
    max_instances: int = 1
    pdo_step: int = 0
    index_step: int = 0


class EsiDevice(msgspec.Struct, frozen=True, kw_only=True):
    """One device of a file, with the modules that fit its slots."""

    vendor: int
    product: int
    revision: int
    vendor_name: str = ""
    type: str = ""
    """Type as it is printed on the device, EL2004."""
    name: str = ""
    group: str = ""
    physics: str = ""
    revision_rule: RevisionRule | None = None
    """CheckRevisionNo; None without one."""
    sync_managers: tuple[EsiSyncManager, ...] = ()
    fmmus: tuple[EsiFmmu, ...] = ()
    pdos: tuple[EsiPdo, ...] = ()
    mailbox: EsiMailbox | None = None
    init_commands: tuple[EsiInitCommand, ...] = ()
    op_modes: tuple[EsiOpMode, ...] = ()
    has_dc: bool = False
    slots: tuple[EsiSlot, ...] = ()
    modules: tuple[EsiModule, ...] = ()
    downloads_modules: bool = False
    """True if the master writes the list of modules to object 0xF030."""
    timeouts: StateTimeouts = StateTimeouts()
    starts_without_sync: bool = False
    """Info/StateMachine/Behavior StartToSafeopNoSync."""
    ebus_ma: int = 0
    """Current from the E-bus in mA; negative for a source."""
    has_reg134_identification: bool = False
    profile_number: int | None = None
    eeprom: EsiEeprom = EsiEeprom()
    alternatives: tuple[EsiAlternative, ...] = ()
    objects: tuple[EsiObject, ...] = ()
    dictionary_file: str = ""

    @property
    def label(self) -> str:
        """Type and revision for messages, ``EL2004 (revision 0x00100000)``."""
        return f"{self.type or hex(self.product)} (revision 0x{self.revision:08X})"

    @property
    def is_soe(self) -> bool:
        """True if PDOs and entries are lists of IDNs (SoE without CoE)."""
        return self.mailbox is not None and bool(self.mailbox.soe_channels) and not self.mailbox.coe

    def pdo(self, index: int) -> EsiPdo | None:
        """Return the PDO *index*, or None."""
        return next((each for each in self.pdos if each.index == index), None)
