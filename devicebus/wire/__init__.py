"""Type-1 frames: bytes to records and back."""
