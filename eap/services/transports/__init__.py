"""Transports of AMS packets: sockets in front of the routers of the stations.

``accepting`` admits TCP connections; ``ams_tcp`` serves port 48898 and connects to peers by it,
with ``ams_connection`` for both; ``ams_discovery`` answers UDP 48899; ``mailbox_frames`` and
``mailbox_stream`` carry frames of type 5 by UDP, Ethernet and TCP; ``mqtt_transport`` uses a
broker.  ``demultiplexer`` finds the station of a packet where several share a socket.
"""
