"""Both sides of the mailbox protocols, as state and time without I/O.

A *server* is what a slave's application does with a message.  A *client* is a conversation: a
generator that yields what to send and is resumed with what came back, so that whoever runs it
decides about buses, retries, fairness and cancelling.
"""
