"""AoE: ADS packets on their way through stations, and the services at its end (ETG.1020).

Nothing here waits, reads a clock or opens a socket: doors hand over what came in and send what
comes out.  The simulated slaves of ``devicebus`` use the same fragments and services.
"""
