"""Exceptions of the project.

EapError
├── CodecError              bytes do not match the layout
│   ├── TruncatedError      ran out of bytes
│   └── MalformedError      enough bytes, illegal value
├── ProtocolError           the peer or the caller broke a rule
│   └── LocalProtocolError
├── ConfigError             the plant file does not describe a plant
├── EnvironmentalError      this machine lacks something: a port, a capability, an interface
├── ImageError              the process image cannot be used as requested
│   ├── EngineGoneError     no engine runs the cycle any more
│   ├── TornReadError       a writer stopped in the middle of writing
│   └── WriterConflictError another writer owns the variables
├── EngineRefusedError      the engine rejects a request and continues unchanged
└── ControlError            a running appliance rejected a request
"""

from __future__ import annotations


def describe_os_error(error: OSError) -> str:
    """Return an error of the system in words: its file, if it names one, and the reason."""
    reason = error.strerror or str(error) or type(error).__name__
    return f"{error.filename}: {reason}" if isinstance(error.filename, str) else reason


class EapError(Exception):
    """Base class; catch this at the edge of the process.

    Attributes:
        has_lines: True if its text has a line for each cause.
    """

    has_lines = False


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
    """The caller requested something that the current state forbids."""


class ConfigError(EapError):
    """The plant file does not describe a plant."""


class EnvironmentalError(EapError):
    """This machine lacks what the configuration needs; the message says how to get it."""


class ImageError(EapError):
    """The process image cannot be used as requested."""


class EngineGoneError(ImageError):
    """The engine that should run the cycle does not."""


class TornReadError(ImageError):
    """A writer stopped in the middle of writing; *writer* names it."""

    def __init__(self, message: str, *, writer: str) -> None:
        super().__init__(message)
        self.writer = writer


class WriterConflictError(ImageError):
    """The variables to be written belong to *holder*."""

    def __init__(self, message: str, *, holder: str) -> None:
        super().__init__(message)
        self.holder = holder


class EngineRefusedError(EapError):
    """The engine rejects a request and continues unchanged; the text gives the reason."""


class ControlError(EapError):
    """A running appliance rejected a request; *code* is for programs."""

    def __init__(self, message: str, *, code: str = "refused") -> None:
        super().__init__(message)
        self.code = code
