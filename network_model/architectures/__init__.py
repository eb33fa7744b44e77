"""Architectures of the hidden layers, one file each; `network.architecture` is the file's name."""
