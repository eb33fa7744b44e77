"""What travels between Tandem's processes: messages, topics, their bytes, and who may do what."""
