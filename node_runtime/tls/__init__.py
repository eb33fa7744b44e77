"""Links with certificates: authentication, rights, and reasons of refusals."""
