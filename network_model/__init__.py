"""Networks: operations, architectures, descriptions and hashes. This package imports nothing else of Tandem."""
