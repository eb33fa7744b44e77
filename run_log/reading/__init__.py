"""Reading a log, a damaged one too."""
