"""AMS routing core without I/O: AMS packets between stations and their services (ETG.1020).

``router`` is the entry: it delivers packets to services of the station or hands them to
``forwarder``, which admits requests to those ``inflight`` and sends them by ``routes``.  ``access``
applies the access rules; ``error_reply`` answers for the router.
``subscriptions``, ``notification_forwarder`` and ``subscription_restorer`` keep notifications
across hops, ``hop_prober`` finds dead hops, ``record`` and ``report`` hold what operators see.
``spec`` and ``directory`` describe a station and its plant; ``mqtt`` is AMS over MQTT.

Nothing here waits, reads a clock or opens a socket: transports hand over received packets and send
the packets of returned actions.  The simulated slaves of ``devicebus`` use the same fragments and
services.
"""
