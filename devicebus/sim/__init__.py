"""Simulated EtherCAT segment for real masters; state and time without I/O.

A frame enters at the master's end and passes every slave controller in the order of the wiring, as
in a real segment.  ``segment``: wiring and frame paths; ``processing``: datagrams at the
controllers; ``esc``, ``syncmanager``, ``fmmu``, ``clock``, ``eeprom``: the controller; ``slave``:
state machine; ``device``, ``pdo``: application; ``spec``: description of a bus; ``fault``: faults
and commands; ``devices``: builders of device kinds.
"""
