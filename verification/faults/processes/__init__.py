"""The real processes of a run, what surrounds them, and what is heard of them."""
