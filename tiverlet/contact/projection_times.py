"""When the velocities of contacts are projected, see velocity_projection.py."""

from ..device import inline

EVERY = 32  # substeps from one projection of all contacts to the next
OFTEN = 8  # the same, near restless particles
NEVER, MAYBE, ALWAYS = range(3)  # whether a substep ends with a projection


@inline
def due(k):
    """Return whether velocities are projected after substep k after a start: NEVER, MAYBE (near what is restless) or ALWAYS."""
    return k % OFTEN // (OFTEN - 1) * (k >= EVERY - 1) + k % EVERY // (EVERY - 1)
