"""The fault suite: real processes, one fault at a random moment of each run. `make faults ARGS=--help`."""
