"""``python -m eap`` is ``eapctl``."""

from __future__ import annotations

from eap.cli import main

if __name__ == "__main__":
    main(prog_name="eapctl")
