"""EAP devices of stations and dictionaries of masters, as services serve them.

``station_device`` has the dictionaries and states of a station, ``station_keeper`` its stored
configuration and the requests to the engine; ``image_values`` and ``master_values`` supply live
entries; ``sources`` writes variables from this host and from CSV files; ``monitoring`` watches the
subscribers of frames.
"""
