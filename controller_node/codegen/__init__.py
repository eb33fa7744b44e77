"""CasADi functions as compiled C."""
