"""The dictionary of a master, live: for its gateway, and for ADS."""
