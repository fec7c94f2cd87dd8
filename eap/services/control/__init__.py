"""The buses of the appliance: conversations and procedures, step by step by the engine."""
