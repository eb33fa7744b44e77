"""What a network is: its operations, architectures, description and hash. Imports nothing else of Tandem."""
