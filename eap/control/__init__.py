"""Control protocol: framing and general records, and the records of each group of methods.

``protocol`` has the framing, ``bus`` the records for buses and gateways, ``device`` those for EAP
devices, ``routes`` those for AMS routes.
"""
