"""Live runs: how punctual they are and what they take of the machine."""
