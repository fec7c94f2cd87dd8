"""ADS services behind the NetID of a bus port: its master, and its slaves by station address."""
