"""Live view of plants, local or remote, for every front end that shows them.

``view`` takes the status of all appliances together: ``status`` is their documents as one,
``findings`` the faults in it, ``rows`` stations and PDs with rates, ``row_filter`` chooses among
them, ``events`` has the changes in words.  ``client`` sends requests to one appliance and
reconnects, by the connections of ``transport`` (this host) and ``ads_connection`` (other hosts).
"""
