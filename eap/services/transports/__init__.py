"""AMS/TCP and UDP 48899: clients that connect, routers that are connected to, and discovery."""
