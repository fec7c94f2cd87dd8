"""The AoE router of each station: doors, services and the loop around ``eap.ams.router``."""
