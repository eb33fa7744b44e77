"""Files to start from. They are copied, and run without changes."""
