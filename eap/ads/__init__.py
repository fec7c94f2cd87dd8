"""ADS services without I/O: requests, sums, dictionaries, symbols, types, states, notifications."""
