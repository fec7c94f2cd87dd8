"""Acyclic access to slaves, on an own bus or behind another station, for every front end.

``access`` is the interface; ``local_slave`` reaches a slave of an own bus through the engine,
``remote_slave`` one of another station by AoE.  Both work on whole operations: an object, an
element or a file goes at the slave's speed, whatever the speed of the client that wants it.
``bus_view`` is the cached description of an own bus, kept current by events of the engine.
"""
