"""One file for each architecture of the hidden layers; the file's name is what `network.architecture` says."""
