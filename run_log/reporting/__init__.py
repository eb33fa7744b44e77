"""Figures and pictures of one run."""
