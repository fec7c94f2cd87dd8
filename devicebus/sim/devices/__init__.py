"""Builders of simulated devices, from a description to a device with its EEPROM.

Every kind has an object dictionary, also without a mailbox: process data is mapped from it.
``build``: segment and slaves; ``objects``: dictionary; ``siibuild``: EEPROM image; ``protocols``:
mailbox; ``drive``: CiA 402 drive; ``esi``: devices from ESI files; ``signal``: changing inputs.
"""
