"""The ``eapctl`` command.

A module has the commands of one area and is imported when one of them is used: ``plant`` (check,
new, run), ``change`` (plan, apply, rollback), ``status``, ``pd``, ``od`` (also state), ``network``
(scan and trace), ``routes``, ``bus``, ``gateway`` (also gw), ``sim``, ``decode``, ``discover``,
``types``, ``log``, ``files`` (import and export-peer), ``inventory``, ``addresses``, ``keys``,
``web``, ``completion``, ``record`` (``recorders`` runs them, ``recordings`` reads their files),
``plot``, ``replay``, ``top`` (``top_model`` has its rows).
A command reads a plant file, starts an appliance in the foreground, or calls an operation of
``eap.ops`` or ``eap.live``, which returns a typed result.  ``output`` prints that as JSON or by the
command's view (``*_view``, ``od_text``).  ``params`` has what commands share, ``group`` the main
command and the exit codes.  ``top_tui`` is the live overview on a screen, ``routes_tui`` its view
of routes.
"""
