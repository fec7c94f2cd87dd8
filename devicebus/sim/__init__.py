"""A simulated EtherCAT segment that real masters accept; state and time without I/O.

A frame enters at the master's end and passes every slave controller in the order of the wiring;
what comes back is the frame that a real segment would return.
"""
