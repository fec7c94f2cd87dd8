"""The bridge ``modbus``: registers of Modbus devices, and registers that are served."""
