"""The nearest images of particles in a periodic box, for kernels."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti

if TYPE_CHECKING:
    from ..features.feature import Scene
    from .periodic import Periodic

FLOW, GRADIENT = 0, 1  # the axes of a shear: images along y move along x


class Images:
    """The nearest images of particles, on the device of one world.

    axes: the periodic axes. sheared: whether images along GRADIENT slide along FLOW. in_state: fields of the state, by name.
    """

    def __init__(self, scene: "Scene", box: "Periodic"):
        add, dim = scene.memory.field, scene.particles.dim
        self.axes, self.sheared, self.real = box.axes, box.sheared, scene.real
        kind = ti.f64 if scene.state.compensated else scene.real  # compensated positions have differences in f64
        self.length = add("Periodic.length", None, width=dim, kind=kind, values=box.away(np.eye(dim, dtype=int)).diagonal())
        self.per_length = add("Periodic.per_length", None, width=dim, kind=kind, values=1 / box.lengths)
        self.half_box_squared = add("Periodic.near", None, kind=kind, values=(1 - 2.0**-20) * box.shortest**2 / 4)
        self.middle = add("Periodic.middle", None, width=dim, values=box.middle)
        self.kind = kind
        self.in_state: dict[str, Any] = {}
        if self.sheared:
            self.rate = add("Periodic.rate", None, kind=ti.f64, values=box.shear)
            self.strain = add("Periodic.strain", None, kind=ti.f64, state=True)
            # Offset along FLOW of the next image along GRADIENT, and how far it slid in the last substep [m].
            self.shift = add("Periodic.shift", None, width=2, kind=kind, state=True)
            self.in_state = {"strain": self.strain, "shift": self.shift}

    @ti.func
    def count_boxes(self, r, axis: ti.template()):  # type: ignore[valid-type]
        """Return the number of box lengths nearest to r along an axis."""
        return ti.floor(r[axis] * self.per_length[None][axis] + ti.cast(0.5, self.real))

    @ti.func
    def nearest(self, r):
        """Return the shortest of the differences r + whole boxes, axis by axis. Fast path: for most pairs this is r itself."""
        if r.dot(r) > self.half_box_squared[None]:
            if ti.static(self.sheared):
                k = self.count_boxes(r, GRADIENT)
                r[GRADIENT] -= k * self.length[None][GRADIENT]
                r[FLOW] -= k * self.shift[None][0]
            for axis in ti.static(self.axes):
                if ti.static(not (self.sheared and axis == GRADIENT)):
                    r[axis] -= self.count_boxes(r, axis) * self.length[None][axis]
        return r

    @ti.func
    def inside(self, x):
        """Return the image in the box of a position x [m]."""
        middle = self.middle[None]
        return middle + self.nearest(x - middle)

    @ti.func
    def relative_displacement(self, moved, r):
        """Return the relative displacement [m] of nearest images, from that of two particles, `moved`, at the difference r."""
        moved[FLOW] -= self.count_boxes(r, GRADIENT) * self.shift[None][1]
        return moved

    @ti.func
    def cell(self, x, axis: ti.template(), turn, count):  # type: ignore[valid-type]
        """Return the cell of `count` along an axis that holds x, in f64, for a viewer `turn` boxes along GRADIENT."""
        at = ti.cast(x[axis], ti.f64)
        if ti.static(self.sheared and axis == FLOW):
            boxes = ti.floor(ti.cast(x[GRADIENT], ti.f64) / self.length[None][GRADIENT])
            at -= (boxes + turn) * self.shift[None][0]
        part = at / self.length[None][axis]
        part -= ti.floor(part)
        return ti.min(ti.cast(part * count, ti.i32), count - 1)

    @ti.func
    def advance_shear(self, h):
        """Advance the strain and the offset of images by a substep of h [s]."""
        step = self.rate[None] * ti.cast(h, ti.f64)
        self.strain[None] = self.strain[None] + step
        height, length = ti.cast(self.length[None][GRADIENT], ti.f64), ti.cast(self.length[None][FLOW], ti.f64)
        offset = self.strain[None] * height
        offset -= ti.floor(offset / length + 0.5) * length
        self.shift[None] = ti.cast(ti.Vector([offset, step * height]), self.kind)
