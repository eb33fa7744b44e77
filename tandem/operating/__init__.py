"""What a person says to a loop that runs: where to go, or the input by hand."""
