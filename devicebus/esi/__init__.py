"""Vendors' device descriptions (ESI, ETG.2000): files read as a stream, devices as records.

``content`` finds the devices of a file, ``device`` and ``objects`` turn elements into the records
of ``records``, ``choice`` applies rules (revisions, PDO assignments, modules), and ``names`` names
the process data.  Files are binary streams of the caller; nothing here opens them.
"""
