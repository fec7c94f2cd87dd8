"""ADS services behind the NetIDs of a station and of its buses.

``ads_service`` executes ADS requests; ``station_ads`` has the services of the router, the system
and the EAP ports; ``station_symbols`` shows the process image as ADS symbols and sends
notifications of them.  ``bus_ads`` serves a bus port and its slaves, ``slave_files`` their files by
FoE, and ``master_ads`` the master itself.
"""
