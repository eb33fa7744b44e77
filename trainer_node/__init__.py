"""The trainer: it collects samples, trains the hidden layers, and sends them to the controller."""
