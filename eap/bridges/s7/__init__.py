"""The bridge ``s7``: data blocks of S7 controllers, and data blocks that are served."""
