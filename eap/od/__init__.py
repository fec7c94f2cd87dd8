"""The object dictionary: one model for every device of this project.

Stations, the type-1 master, the router and the simulated slaves all serve their objects through
:class:`eap.od.dictionary.ObjectDictionary`, which alone decides what an SDO may read and write.
``model`` has objects and entries, ``abort`` the abort codes, ``info`` SDO information, ``notation``
the texts of values; ``profiles`` has the tables of the device profiles.
"""
