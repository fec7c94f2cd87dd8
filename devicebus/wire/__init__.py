"""Wire formats of the device protocol, without I/O.

``datagram``: datagrams of a type-1 frame, and the requests and replies of a master; ``register``:
registers of a slave controller; ``sii``: EEPROM image of a slave; ``alstatus``: AL states and AL
status codes.
"""
