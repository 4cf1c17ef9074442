"""Plain geometry in NumPy and f64: rays, segments, triangles, trees of boxes around many of them, rows in order. It knows of no
world."""
