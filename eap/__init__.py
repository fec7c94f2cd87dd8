"""EtherCAT Automation Protocol (ETG.1005) appliance; docs/architecture.md draws its rooms."""
