"""Shared state of an appliance: runtime folder, handover, engine messages, stored configuration.

``folder`` finds running appliances, ``startup`` runs a child process, ``attach`` is the API of user
programs, ``busfile`` and ``plantfile`` load files with the buses that they name.
"""
