"""Programs beside a run that send what must not be obeyed."""
