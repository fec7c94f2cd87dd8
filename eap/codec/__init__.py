"""Codecs: bytes to records and back.  Pure functions, no state, no I/O.

``wire`` builds records from annotations.  Frames: ``ethercat``, ``pd`` (type 4), ``mailbox`` (type
5), ``arp``.  Mailbox protocols: ``coe``, ``foe``, ``soe``, ``eoe`` and ``ams``.  ADS: ``ads``,
``adsnotification``, ``adssymbol``, ``amsdiscovery`` (UDP 48899), ``staticroutes`` (XML, which
``xmlstream`` reads).  Values:
``values`` and, by name, ``datatypes``.
"""
