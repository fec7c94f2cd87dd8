"""The EAP devices of the stations: dictionaries, states, changes, and values from outside."""
