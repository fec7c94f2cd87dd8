"""Values by MQTT: JSON on topics, Home Assistant's discovery, and Sparkplug B.

``process`` connects cores to brokers: ``json_values`` (with ``home_assistant``) and
``sparkplug_node`` (with ``sparkplug_types``) decide on messages, ``topics`` names them.  Each of
the two has a connection of its own, because a client has one last will.
"""
