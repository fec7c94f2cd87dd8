"""The plant file: structs, loading with file and line, semantic checks."""
