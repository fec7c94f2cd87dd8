"""The supervisor: starts the other processes of an appliance and holds what must outlive them."""
