"""ADS services core without I/O.

``request`` parses requests into operations and encodes answers, on both sides;
``device`` carries operations out in its spaces (``space``): dictionaries (``objects``), variables
(``symbols``), I/O devices and masters (``io``); ``notifications`` samples values for clients.
"""
