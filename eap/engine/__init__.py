"""The engine process: stations and buses in their cycles, and their reconfiguration while they run.

``process`` runs the cycles, ``build`` makes the objects, ``rebuild`` replaces a running station.
``engine_bus`` runs a bus with its ``bus_mapping``; ``bus_requests`` and ``bus_report`` serve
services.
"""
