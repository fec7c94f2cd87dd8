"""A type-1 master as state and time, without I/O.

Frames go out and come back through :mod:`link`.  What the master does is written as *procedures*
(:mod:`procedure`): generators that yield accesses to slaves and are resumed with the answers, so
that a scan, a state change and a hundred mailboxes run side by side over one wire.
:class:`devicebus.master.master.Master` puts them together; a driver feeds it frames and time.
"""
