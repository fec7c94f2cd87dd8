"""What answers ADS behind the NetIDs of a station: dictionaries, variables, states, I/O list."""
