"""The mailbox gateway of ETG.8200: mailbox messages from Ethernet to slaves and to the master.

Decisions only: what a message is, whom it is for, whether it may pass and what goes back.  Nothing
here sends, waits or knows a clock.
"""
