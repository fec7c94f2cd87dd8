"""Bytes to records and back.  Pure functions, no state, no I/O."""
