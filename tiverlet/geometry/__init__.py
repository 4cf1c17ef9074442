"""Plain geometry in NumPy and f64: rays, segments, triangles, and trees of boxes around many of them. It knows of no world."""
