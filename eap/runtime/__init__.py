"""Assembly: specifications become processes, sockets and the control protocol."""
