"""Drivers: each module owns one kind of socket, file or timer.

Process data: ``ethernet``, ``udp``, ``tcp``, ``tcpport``, ``loopback``, with ``mmsg`` for batches.
Opening of sockets: ``ipsocket``, ``packetsocket``, ``bpf``.  Buses: ``busport``.  Hosts:
``neighbour``, ``interface``, ``host``.  Links: ``mqtt``, ``reconnecting``.  Process:
``image_file``, ``ticker``, ``realtime``.  The admission of connections, ``connections``, does no
I/O.
"""
