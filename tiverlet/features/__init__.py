"""The contract of all that acts on particles."""
