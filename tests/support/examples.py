"""How many examples a property takes where few are as good as many."""

from __future__ import annotations

import os

from hypothesis import settings

FEW = settings(max_examples=100 if os.environ.get("EAP_LONG") else 25)
"""For costly properties whose first examples reach every branch that 100 of them reach.

``EAP_LONG=1`` takes the 100.
"""
