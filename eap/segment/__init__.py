"""The process of a simulated EtherCAT segment."""
