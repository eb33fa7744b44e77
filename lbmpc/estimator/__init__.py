"""State estimation from measurements, and the labels that belong to it."""
