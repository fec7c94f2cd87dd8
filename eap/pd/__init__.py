"""Cyclic process data (ETG.1005): stations, publishers, subscribers and their image.  No I/O.

Frames enter through ``FrameChannel.drain`` and the time through ``now_ns``.  All variables and
counters are in the process image (``image``, ``layout``, ``words``), where readers find them.

Cycle: ``engine``, ``station``.  Sending: ``publisher``, ``txframe``, ``poll``.  Receiving:
``subscriber``, ``subscription``, ``sequence``, ``address``.  Values: ``links``, ``copyplan``.
Configuration: ``spec``, ``rules``, ``device``, ``handover``.  Status: ``report``, ``monitor``.
Interfaces to the drivers: ``link``.
"""
