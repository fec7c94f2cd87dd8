"""Every exception the project raises on purpose.

EapError
├── CodecError              bytes do not match the layout
│   ├── TruncatedError      ran out of bytes
│   └── MalformedError      enough bytes, illegal value
├── ProtocolError           the peer or the caller broke a rule
│   └── LocalProtocolError
├── ConfigError             the plant file does not describe a plant
├── EnvironmentalError      this machine lacks something: a port, a capability, an interface
├── ImageError              the process image cannot be used as asked
│   ├── EngineGoneError     nobody runs the cycle any more
│   ├── TornReadError       a writer stopped in the middle of writing
│   └── WriterConflictError somebody else owns what was to be written
├── EngineRefusedError      the engine continues with what it ran before
└── ControlError            a running appliance refused a request
"""

from __future__ import annotations


class EapError(Exception):
    """Base class; catch this at the edge of the process."""


class CodecError(EapError, ValueError):
    """Bytes and layout disagree."""

    def __init__(self, message: str, *, layout: str, offset: int = 0) -> None:
        super().__init__(f"{layout} at offset {offset}: {message}")
        self.layout = layout
        self.offset = offset


class TruncatedError(CodecError):
    """The buffer ends before the layout does."""


class MalformedError(CodecError):
    """A field holds a value that the standard forbids."""


class ProtocolError(EapError):
    """A rule of the protocol was broken."""


class LocalProtocolError(ProtocolError):
    """Our caller asked for something the current state forbids."""


class ConfigError(EapError):
    """The plant file does not describe a plant."""


class EnvironmentalError(EapError):
    """This machine lacks what the configuration needs; the message says how to get it."""


class ImageError(EapError):
    """The process image cannot be used as asked."""


class EngineGoneError(ImageError):
    """The engine that should run the cycle does not."""


class TornReadError(ImageError):
    """A writer stopped in the middle of writing; *writer* names it."""

    def __init__(self, message: str, *, writer: str) -> None:
        super().__init__(message)
        self.writer = writer


class WriterConflictError(ImageError):
    """What was to be written belongs to *holder*."""

    def __init__(self, message: str, *, holder: str) -> None:
        super().__init__(message)
        self.holder = holder


class EngineRefusedError(EapError):
    """The engine does not do what it was asked for, and continues as before; the text says why."""


class ControlError(EapError):
    """A running appliance refused a request; *code* is for programs."""

    def __init__(self, message: str, *, code: str = "refused") -> None:
        super().__init__(message)
        self.code = code
