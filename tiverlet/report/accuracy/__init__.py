"""Error against run time, on scenes with known answers and on the user's own scenes."""
