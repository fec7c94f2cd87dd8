"""The supervisor: starts the child processes of an appliance and holds what must outlive them.

``process`` is its main loop, ``child`` one child process, ``sockets`` the shared sockets.
"""
