"""The control protocol of an appliance: framing, and the records of its methods by subject."""
