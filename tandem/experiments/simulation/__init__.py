"""Closed-loop runs in lock-step, and what may go wrong in them."""
