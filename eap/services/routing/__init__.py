"""AMS routing of each station: router, routes, local services, traces and scans.

``station_router`` runs ``eap.ams.router`` in the event loop, ``station_routes`` holds the routes
and ``station_routing`` their changes at run time; ``service`` has the local services and the local
client, ``remote_routers`` requests to other routers by UDP 48899, ``tracing`` and ``scanning`` what
``eapctl trace``, ``routes test`` and ``scan`` ask, and ``route_rows`` the records of the control
protocol.
"""
