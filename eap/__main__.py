"""``eapctl``, and ``python -m eap``, which is the same."""

from __future__ import annotations

import signal


def main() -> None:
    """Run one command; SIGINT ends the process without a traceback while modules are imported."""
    is_default = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_default:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from eap.cli.group import main as eapctl

    if is_default:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    eapctl(prog_name="eapctl")


if __name__ == "__main__":
    main()
