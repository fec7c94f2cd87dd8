"""Vendors' device descriptions (ESI, ETG.2000): files read as a stream, devices as records.

``tree`` turns XML into elements with line numbers, ``content`` finds the devices of a file,
``device``, ``objects`` and ``modules`` turn elements into the records of ``records``, and
``choice`` applies rules: revisions, PDO assignments, operation modes.  Files are binary streams of
the caller; nothing here opens them.
"""
