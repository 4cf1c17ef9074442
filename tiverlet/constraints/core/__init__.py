"""Parts that constraints are made of."""
