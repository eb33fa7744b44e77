"""The state from what is measured, and the labels that go with it."""
