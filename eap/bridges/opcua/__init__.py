"""OPC UA server: the variables of a plant as nodes, for SCADA systems and other clients.

``values.py`` converts types and values, ``nodes.py`` plans the nodes of a plant; both are cores
without asyncua, which ``address_space.py``, ``sessions.py``, ``certificates.py`` and ``process.py``
use.
"""
