"""The page on which an experiment is reported."""
