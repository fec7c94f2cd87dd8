"""Simulated devices: from a description to a device with its EEPROM.

Every kind has an object dictionary inside, also where no mailbox shows it to a master: process data
is mapped from there.
"""
