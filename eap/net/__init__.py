"""Drivers: each owns one socket, file or timer and knows nothing of the protocol."""
