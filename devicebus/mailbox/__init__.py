"""Both sides of the mailbox protocols, as state and time without I/O.

A *server* (``coe_server``, ``foe_server``, ``soe_server``, ``aoe_server``) is a protocol of a
slave's application; :mod:`server` puts the protocols behind one mailbox.  A *client*
(``coe_client``, ``foe_client``, ``soe_client``, ``aoe_client``) is a conversation
(:mod:`conversation`): a generator that yields requests and is resumed with the replies that answer
them, so that its driver decides about buses, retries, fairness and cancelling.  ``eoe`` and ``voe``
hold both sides.
"""
