"""The real processes of a run, their environment, and the messages that they publish."""
