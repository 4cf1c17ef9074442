"""The contract of the shapes of moving colliders on the device."""

from ..device import ti


class Shape:
    """A shape that particles stay outside of, on the device, in a frame of its own; radius: by what it is thickened [m].

    may_miss_touches: find_first_touch() may miss a touch, so the ends of displacements are tested with is_penetrating().
    can_slide: nothing bounces, so a particle that slides on the shape may be pushed along the normal at the start of its
    displacement.
    """

    may_miss_touches = False
    can_slide = False

    @ti.func
    def find_first_touch(self, a, e, contact_distance, close, limit):
        """Find the first touch of a particle on its way from a to a + e.

        contact_distance: of its center from the shape. close: the size of rounding. limit: how far a start that is inside may be
        pushed out. Returns the fraction of the way (2 for none), the depth at a + e below the plane that touches there, and its
        normal.
        """
        return 0 * contact_distance + 2, 0 * contact_distance, 0 * e

    @ti.func
    def facet_gap(self, f, q, e, contact_distance, at_start: ti.template()):  # type: ignore[valid-type]
        """Return the gap at q to facet f [m], the normal, and the curvature of the gap [1/m] along a displacement e.

        A facet that another one hides is far away. at_start: of a substep; then one that q is behind is hidden by any nearer one.
        At the end it is not, since what passed a thin solid is behind its far side.
        """
        return 0 * q[0], q, 0 * q[0]

    @ti.func
    def rounding(self, q):
        """Return the size of rounding around a point q of the shape's frame [m]."""
        return 0 * q[0]

    @ti.func
    def is_penetrating(self, q, contact_distance, close):
        """Whether a particle with its center at q, in the shape's frame, is inside of the shape."""
        return False
