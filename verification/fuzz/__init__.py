"""Bytes that nobody should send, given to everything that reads bytes: `make fuzz`."""
