"""Files that a person starts from. They are copied, and run as they are."""
