"""Messages between processes, over Zenoh."""
