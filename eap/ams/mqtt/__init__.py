"""AMS over MQTT without I/O: networks, peers, topics and payloads."""
