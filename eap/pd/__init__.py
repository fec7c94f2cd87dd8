"""Cyclic process data: publishers, subscribers and the cycle.  State and time, no I/O.

Frames enter through ``Channel.drain``, time through ``now_ns``; all variables and all counters live
in the process image (``image.py``), and readers get them there.
"""
