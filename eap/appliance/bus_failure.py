"""Old place of what is in bus_errors.py and bus_request.py now."""

from eap.appliance.bus_errors import to_error
from eap.appliance.bus_request import no_mailbox

__all__ = ["no_mailbox", "to_error"]
