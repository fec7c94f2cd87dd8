"""Mailbox gateways (ETG.8200): mailbox messages from Ethernet to slaves and to the master.

What a gateway decides stands here without sockets and clocks: what a message is, whom it is for,
whether it may pass and what goes back.  Beside it are the clients of any gateway, which have both.
"""
