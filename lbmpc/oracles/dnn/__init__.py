"""The network oracle: its expressions, its adaptation law, and the trial of new hidden layers."""
