"""Device profiles as tables: which objects a device has, what each entry is and means.

A table is data.  The rooms that serve a device make its dictionary from it, and the page of all
objects in the documentation is written from it.
"""
