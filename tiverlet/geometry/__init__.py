"""Plain geometry in NumPy and f64, independent of worlds: rays, segments, triangles, bounding volume trees, sorted rows."""
