"""The live view of ``eapctl routes``: a client of running appliances, in a terminal.

``table`` makes the rows of the table and is its widget; ``app`` has the screen, its forms, and the
requests to the appliances.  Needs Textual, which only the extra ``tui`` installs.
"""
