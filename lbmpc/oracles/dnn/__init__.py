"""The network oracle: its expressions, its law of adaptation, and what new hidden layers must show."""
