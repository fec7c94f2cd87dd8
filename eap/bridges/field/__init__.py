"""Controllers of other protocols: variables read from them and written to them, and served to them.

S7 and Modbus share all of it: a controller is read in spans of its memory, a server is a memory
that clients read and write.  A protocol adds its conversations and answers (``protocol.py`` says
what they are).
"""
