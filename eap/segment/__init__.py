"""A simulated segment as a process."""
