"""Device behind an EAP port: its dictionary, its state machine, and changes to both.

The dictionary is the configuration.  ``eap_spec`` fills it from the specification of a station and
reads back what the engine runs; downloads change it (``eap_dictionary``, ``eap_rules``), and
``eap_state`` starts and stops it.  ``configuration`` stores and compares dictionaries, ``rollout``
orders the changes of several stations.  ``live_dictionaries`` has those of routers and bus
masters.  No I/O: live values come through a protocol, and a change of state calls back.
"""
