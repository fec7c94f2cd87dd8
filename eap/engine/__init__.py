"""The engine process: stations and buses in their cycles, and their change while they run."""
