"""Device profiles as tables: objects of a device, type and meaning of each entry.

A table is data.  The services of a device make its dictionary from it, and the page of all
objects in the documentation is written from it.
"""
