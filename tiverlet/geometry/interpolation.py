"""Where something is on its straight way during a frame."""

from ..device import ti


@ti.func
def interpolate(a, b, frame_fraction):
    """Return the place between a, where the frame begins, and b; what rests keeps its place bit for bit."""
    return ti.select(a == b, a, a * (1 - frame_fraction) + b * frame_fraction)
