"""Bridges: optional processes that take the values of a plant to other systems, and writes back.

``process`` runs one for the supervisor: ``run_bridge`` is all that a ``main`` calls.  ``bridge`` is
what a bridge sees of the plant: its values by ``feed``, writes, and the status that ``eapctl
status`` shows.  Each bridge is a package of its own beside these modules, and alone imports the
library of its protocol.  A bridge uses the control protocol and nothing else of the plant.
"""
