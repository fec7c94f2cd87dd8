"""Mailbox gateways (ETG.8200): one for each bus, with its clients, sessions and access rules.

``gateway`` dispatches requests; ``sessions`` has those of clients with slaves and with the master's
dictionary; ``message_codecs`` and ``transfer_codecs`` are the server's side of the protocols;
``dialect_handler`` serves the high-nibble dialect; ``admission`` applies access rules and writes
the audit; ``reply_encoder`` sends answers and counts them; ``gateway_transport`` binds a gateway to
a socket; ``opening`` builds the gateways from the plant file.
"""
