"""Core of the mailbox gateway (ETG.8200), its high-nibble dialect, and its clients.

``requests`` decodes destinations and operations of requests and encodes error answers;
``error_table`` relates the error codes of all protocols; ``request_tracker`` limits clients;
``dialect`` is the codec of the dialect.  ``client`` has the clients of any
gateway, with ``conversations`` as their common core and ``slaves`` to read the slaves of a master.
"""
