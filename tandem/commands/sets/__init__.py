"""`tandem sets`: certified sets, computed, checked and drawn."""
