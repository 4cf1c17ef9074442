"""The step of a world, and how a world is built, edited and kept."""
