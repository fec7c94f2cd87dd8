"""Operations of the commands, each with a typed result; no terminal and no argument parsing.

``client`` is the client of the control protocol.  ``plant`` checks plant files and changes running
plants.  ``od`` reads and writes dictionaries, ``od_devices`` finds the device of a command.
``routing`` sends ADS requests through routers and lists their routes.  A bus is a master of its own
(``bus_session``), one of a running station (``bus_running``) or a mailbox gateway
(``bus_gateway``); ``bus_info``, ``bus_objects`` and ``bus_foe`` are the services on it.  ``decode``
makes records of captured frames.
"""
