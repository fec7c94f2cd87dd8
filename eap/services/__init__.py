"""The services process: the control protocol, devices, acyclic frames, the way to the engine."""
