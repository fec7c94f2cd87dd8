"""Plant file: reading, checks with file and line, and specifications of engine and router.

``structs`` has the sections of the file and their keys, ``document`` reads YAML into them,
``finding`` collects errors with their lines, and ``index`` resolves names.  ``ports``, ``bus``,
``variables``, ``exchange``, ``routes``, ``brokers`` and ``access`` each check one part of the file
and resolve its references.  ``load`` runs all of them and returns the specifications.
``new_plant`` writes a file.
"""
