"""Which particles are near: cell list, search, neighbour list, queries."""
