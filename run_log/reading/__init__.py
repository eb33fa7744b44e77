"""Reading a log, also a damaged one."""
