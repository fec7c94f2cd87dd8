"""ADS services core without I/O.

``request`` with ``operation`` and ``sum`` parses requests and encodes answers, on both sides;
``device`` carries operations out in its spaces (``space``): dictionaries (``objects``), variables
(``symbols``), I/O devices and masters (``io``); ``notifications`` samples values for clients.
``endpoint`` names the connection that a request arrived by.
"""
