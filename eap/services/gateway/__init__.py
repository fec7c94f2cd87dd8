"""The mailbox gateways of an appliance: sockets and clients on one side, buses on the other."""
