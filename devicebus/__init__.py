"""The device bus: EtherCAT type 1, below the stations."""
