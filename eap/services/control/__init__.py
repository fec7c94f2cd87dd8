"""Control socket of an appliance: its server, its methods, and the audit.

``control_server`` serves clients and has their changes audited; ``methods`` reads and writes
process images, ``bus_methods`` serves buses and gateways, ``device_methods`` EAP devices,
``route_methods`` routes, AMS requests and the configuration of routers; ``status`` collects the
status document; ``audit`` writes changes and denied requests to a file.
"""
