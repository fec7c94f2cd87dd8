"""The services process: everything of an appliance that is not cyclic.

``process`` starts it and ``sockets`` opens its transports.  ``transports`` carry AMS packets and
mailbox frames, ``routing`` routes them; ``ads``, ``gateway`` and ``control`` are the front ends of
clients; ``device`` serves EAP devices and ``slaves`` the slaves of buses.  ``engine_link`` reaches
the engine; ``tasks`` and ``limited_log`` are used by all of them.
"""
