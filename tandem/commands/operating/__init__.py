"""`tandem manual`, `tandem pause`, `tandem auto` and `tandem set-point`."""
