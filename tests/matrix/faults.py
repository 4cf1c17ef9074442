"""Known faults: cells of the matrix that do not keep their equality, and why. What is mended has to be struck out."""

KNOWN: dict[tuple[str, str], str] = {}
