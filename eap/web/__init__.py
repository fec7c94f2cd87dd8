"""The page for browsers and its JSON API, an optional process beside a plant.

``process`` runs it, for the supervisor or by hand.  ``feed`` follows the plant by ``eap.live``,
``topics`` makes messages of it, and keeps the past of trends.  ``server`` answers HTTP by
aiohttp: ``api`` the requests, ``sockets`` the WebSockets, ``guard`` decides on each request, with
``sessions``.  Only this package imports aiohttp; docs/web-api.md describes the messages.
"""
