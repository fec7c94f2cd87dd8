"""A type-1 master as state and time, without I/O.

:mod:`link` sends and receives frames.  The actions of the master are *procedures*
(:mod:`procedure`): generators that yield datagrams for slaves and are resumed with the replies, so
that a scan, a state change and a hundred mailboxes share one link.  :mod:`scan`, :mod:`startup`,
:mod:`bring`, :mod:`esm`, :mod:`clocks`, :mod:`eeprom`, :mod:`watch` and :mod:`diagnosis` are such
procedures; :mod:`findings` turns their results into text.  :mod:`cycle` and :mod:`image` exchange
process data; :mod:`mailboxes` and :mod:`queues` are the mailbox of one slave.
:class:`devicebus.master.master.Master` puts them together; a driver feeds it frames and time.
"""
