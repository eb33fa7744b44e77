"""One trainer for many plants."""
