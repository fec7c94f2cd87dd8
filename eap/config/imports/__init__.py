"""Files of other tools, read into records, and plant files made of these.

``records`` has what all readers yield.  Readers: ``typefile`` (types and symbols of TMC and TPY
files and of projects), ``twincat`` (projects of TwinCAT 3), ``treeitems`` (Automation Interface
XML, which it also writes).  ``stations`` decides what the records become in a plant, ``planttext``
writes that, and ``insertion`` adds it to an existing plant file.
"""
