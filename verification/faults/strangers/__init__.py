"""Programs beside a run that send messages which must not be obeyed."""
