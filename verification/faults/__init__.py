"""The fault suite: real processes, one fault at a random moment, and what held. `make faults ARGS=--help`."""
