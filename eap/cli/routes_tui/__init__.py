"""The live view of ``eapctl routes``: a client of running appliances, in a terminal.

``link`` asks them, ``table`` says what a table shows, ``app`` and ``forms`` put it on the screen.
Needs Textual, which only the extra ``tui`` brings along.
"""
