"""The live overview in a terminal, with textual: an extra that other commands do not need."""
