"""Writing a log while the run happens."""
