"""Acyclic access to slaves, on an own bus or behind another station, for every front end.

``access`` is the interface, and reaches a slave of an own bus through the engine; ``remote_slave``
reaches one of another station by AoE.  Both work on whole operations: an object, an element or a
file goes at the slave's speed, whatever the speed of the client; ``file_stream`` pumps files.
``bus_client`` is one bus as the engine serves it, with its description and its mailbox queues;
``segment_link`` sends commands to a simulated bus.
"""
