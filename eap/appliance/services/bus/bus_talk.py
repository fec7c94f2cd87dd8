"""Old place of MailboxTurn."""

from eap.appliance.services.bus.mailbox_queue import MailboxTurn as Talk

__all__ = ["Talk"]
