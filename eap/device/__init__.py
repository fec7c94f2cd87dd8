"""Device behind an EAP port: its dictionary, its state machine, and changes to both.

The dictionary is the configuration.  A specification of a station fills it, and so do a tool's
downloads; what the engine is to run is read back from it.  No I/O in here: live values come in
through a protocol, and what a change of state does is a callback.
"""
