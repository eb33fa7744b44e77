"""What travels between Tandem's processes: messages, topics, their bytes, and the network's description."""
