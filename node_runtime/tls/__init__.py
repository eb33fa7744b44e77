"""Links with certificates: who is let in, what each may do, and why a link is refused."""
