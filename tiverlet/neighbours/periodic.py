"""Periodic boxes: every particle has images, one box length apart along each periodic axis, and acts by the nearest image."""

import contextlib
from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..features.feature import Feature, Knob, Scene
from ..features.flag import Flag
from ..features.regrouping import Regrouping
from .images import FLOW, GRADIENT, Images

if TYPE_CHECKING:
    from ..particles import Particles

AXES = "xyz"
SPARE = 2.2  # smallest length of a sheared box, in contact distances
COUNTED = 2.0**62  # largest number of boxes that is counted


class Periodic(Feature):
    """A box that repeats without end along some axes (periodic boundaries): particles interact across its ends.

    low, high: corners of the box, (dim,) [m]; values along other axes are ignored. axes: the periodic axes, such as (0,) for x
    alone; None for all. shear: rate of a simple shear [1/s], for boxes without walls along x and y (Lees and Edwards 1972): the
    images one box further along y move along x at shear times the height of the box. The shear is live.

    Contacts, links, angles and forces between particles act on the nearest image: r = x_i - x_j minus whole boxes. It is unique
    within half a box. No pair in contact, no PairForce and no link may reach further. world.position stays **unwrapped**: a
    particle that leaves the box goes on without a jump, so mean square displacements follow from positions alone.
    `wrap(position)` returns positions in the box; recordings draw particles there. Features that read positions read unwrapped
    ones (Pin, Path, Attractor, Force). Walls and obstacles act on images: HalfSpace and Box only along axes that are not
    periodic; a Ball or a Capsule on the image nearest to its middle; a Polygon, Mesh or Sdf on the image in the box, so the
    obstacle must lie within the box.

    In f32 a coordinate is rounded to 6e-8 of its size: after 100 boxes a position is accurate to 1e-5 of a box. For scenes that
    drift so far, such as a flow or a long shear, use "f64" or "f32-compensated".

    With shear, velocities are those of the unwrapped motion, a linear profile v_x = shear y through all boxes. Walls and
    obstacles cannot be used with shear. Drag and Wind slow the flow itself. The neighbour list takes account of the strain.

    Raises ValueError for a box that is too small for its contents. A world has at most one.
    """

    is_fixed_in_space = True
    compiled_for = ("sheared",)
    sheared = Flag(lambda f: f.shear != 0, "Whether there is a shear.")
    host_only = ("low", "high")
    for_users = ("lengths", "offset", "strain")
    _last_strain_and_offset = 0.0, 0.0
    shear = Knob(lambda f, v: checks.number("Periodic", "shear", v), "Rate of the shear [1/s].")
    code_size = 0.1
    conserves = True

    def __init__(self, low: ArrayLike, high: ArrayLike, axes: Sequence[int] | None = None, *, shear: float = 0.0):
        low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        if low.ndim != 1 or low.shape != high.shape or len(low) not in (2, 3):
            raise ValueError(f"Periodic: low and high have shapes {low.shape} and {high.shape}; two corners (dim,) are needed.")
        dim = len(low)
        self.low = checks.vector("Periodic", "low", low, dim, infinite=True)
        self.high = checks.vector("Periodic", "high", high, dim, infinite=True)
        chosen = range(dim) if axes is None else checks.indices("Periodic", "axes", axes, dim, things="axes")
        self.axes: tuple[int, ...] = tuple(sorted({int(k) for k in chosen}))
        if not self.axes:
            raise ValueError("Periodic: axes = () leaves nothing periodic; give (0,) for x, or leave the box out.")
        for k in self.axes:
            if not (np.isfinite([low[k], high[k]]).all() and low[k] < high[k]):
                raise ValueError(
                    f"Periodic: along axis {k} the box goes from {low[k]:g} to {high[k]:g} m, which is no length. Give finite "
                    "corners, low below high."
                )
        self.shear = shear

    def prepare(self, particles: "Particles", inv_mass: np.ndarray) -> None:
        """Check the dimension, and that x and y are periodic where there is a shear."""
        if len(self.low) != particles.dim:
            raise ValueError(f"Periodic: low has {len(self.low)} coordinates, but the particles are in {particles.dim}D.")
        if self.sheared and not {FLOW, GRADIENT} <= set(self.axes):
            raise ValueError(f"Periodic: shear = {self.shear:g} needs a box that is periodic along x and y, not {self.axes}.")

    @property
    def does_work(self) -> bool:
        """Whether images move, which does work on the particles."""
        return self.shear != 0

    @property
    def lengths(self) -> np.ndarray:
        """Lengths of the box, (dim,) [m]; inf along axes that are not periodic."""
        some = np.isin(np.arange(len(self.low)), self.axes)
        return np.where(some, np.where(some, self.high, 1.0) - np.where(some, self.low, 0.0), np.inf)

    @property
    def middle(self) -> np.ndarray:
        """Middle of the box, (dim,) [m]; 0 along axes that are not periodic."""
        some = np.isfinite(self.lengths)
        return (np.where(some, self.low, 0.0) + np.where(some, self.high, 0.0)) / 2

    @property
    def shortest(self) -> float:
        """Length of the shortest periodic side [m]."""
        return float(self.lengths.min())

    def refuse(self, who: str, what: str, far: float, smaller: str, half: bool = False) -> None:
        """Raise ValueError if a reach `far` [m] exceeds half a box, or, with `half`, equals it.

        who, what, smaller: words of the message. A sheared box is longer by a tenth, to leave room for the skin of the list.
        """
        k, least = int(np.argmin(self.lengths)), (SPARE if self.sheared else 2) * far
        if least > self.shortest or (half and least == self.shortest):
            raise ValueError(
                f"Periodic: along {AXES[k]} the box is {self.shortest:g} m long, but {who}: {what} up to {far:g} m apart, and "
                f"would meet two images of the same particle. Make the box longer than {least:g} m there, or {smaller} smaller."
            )

    @property
    def strain(self) -> float:
        """The shear strain: the integral of the rate over time."""
        return self._strain_and_offset[0]

    @property
    def _strain_and_offset(self) -> tuple[float, float]:
        """The strain, and the offset along x of the image one box further along y [m]."""
        images = vars(self.dev).get("images")
        if images and images.sheared:
            with contextlib.suppress(RuntimeError):  # fields cannot be read before the world is complete or after it is closed
                read = self.scene.memory.read
                self._last_strain_and_offset = float(read(images.strain)[0]), float(read(images.shift)[0, 0])
        return self._last_strain_and_offset

    def continued(self, other: "Periodic") -> None:
        """Take over the strain and offset of the same box in another world."""
        if self.dev.images.sheared:
            strain, offset = other._strain_and_offset
            self.scene.memory.write(self.dev.images.strain, strain)
            self.scene.memory.write(self.dev.images.shift, [offset, 0.0])

    def copy(self) -> "Periodic":
        """Return a copy without the strain, which belongs to a world."""
        new: Any = super().copy()
        new._last_strain_and_offset = 0.0, 0.0
        return new

    def release(self) -> None:
        """Store strain and offset before the fields are freed: a world that is rebuilt reads them meanwhile."""
        self._last_strain_and_offset = self._strain_and_offset
        super().release()

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether the widest particle, which must fit into the box, has the same radius as before."""
        return change.now.radius.max(initial=0.0) == change.before.radius.max(initial=0.0)

    def bind(self, scene: Scene) -> None:
        """Declare the fields of the box on the device."""
        self.scene, scene.periodic = scene, self
        self.dev.images = scene.state.images = Images(scene, self)
        self.changed = False

    def upload(self) -> None:
        """Write the shear rate to the device."""
        if self.dev.images.sheared:
            self.scene.memory.write(self.dev.images.rate, self.shear)

    # Positions of images, in NumPy.

    @property
    def offset(self) -> float:
        """Offset along x of the image one box further along y [m]."""
        return self._strain_and_offset[1]

    def outline(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the edges of the box, (m, 2, dim) [m], open axes from low to high (dim,) [m]."""
        some = np.isfinite(self.lengths)
        ends = np.stack([np.where(some, self.low, low), np.where(some, self.high, high)])
        corners = np.array(list(product((0, 1), repeat=len(some))))
        pairs = [(a, b) for a in corners for b in corners if (b - a).sum() == 1 and (b >= a).all()]
        return np.array([[ends[a, range(len(a))], ends[b, range(len(b))]] for a, b in pairs])

    def boxes(self, position: ArrayLike) -> np.ndarray:
        """Return how many boxes along each axis positions (n, dim) are from the box, (n, dim) integers: LAMMPS's image flags.

        With shear, the velocity of the image in the box is v_x - boxes[:, 1] * shear * height.
        """
        return self._count_boxes(np.asarray(position, dtype=np.float64) - self.middle)

    def wrap(self, position: ArrayLike) -> np.ndarray:
        """Return the images of positions (n, dim) [m] in the box: low <= x < high along periodic axes, up to rounding."""
        x = np.asarray(position, dtype=np.float64)
        return x - self.away(self.boxes(x))

    def difference(self, a: ArrayLike, b: ArrayLike) -> np.ndarray:
        """Return a - b between nearest images [m], for positions (..., dim)."""
        r = np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)
        return r - self.away(self._count_boxes(r))

    def away(self, boxes: ArrayLike) -> np.ndarray:
        """Return the displacement by `boxes`, (..., dim), numbers of boxes along each axis, (..., dim) [m]."""
        boxes = np.asarray(boxes)
        out = np.asarray(boxes * np.where(np.isfinite(self.lengths), self.lengths, 0.0))
        out[..., FLOW] += boxes[..., GRADIENT] * self.offset
        return out

    def ghosts(self, position: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """Return all images within `reach` [m] of the box: their particles and positions, first those in the box, in order."""
        x = self.wrap(position)
        found, places = [np.arange(len(x))], [x]
        along = 2 if self.offset else 1  # in a shear, boxes further along y are offset along x
        steps = [range(-along, along + 1) if k == FLOW else range(-1, 2) for k in range(len(self.low))]
        steps = [step if k in self.axes else (0,) for k, step in enumerate(steps)]
        low, high = (np.where(np.isfinite(self.lengths), v, s) for v, s in ((self.low, -np.inf), (self.high, np.inf)))
        for step in product(*steps):
            if any(step):
                image = x + self.away(np.array(step))
                near = ((image >= low - reach) & (image <= high + reach)).all(axis=1)
                found.append(np.flatnonzero(near))
                places.append(image[near])
        return np.concatenate(found), np.concatenate(places)

    def _count_boxes(self, r: np.ndarray) -> np.ndarray:
        """Return the number of boxes along each axis nearest to r, (..., dim); 0 where r is NaN or exceeds COUNTED boxes."""
        out = np.zeros(r.shape, dtype=np.int64)
        r = r.copy()
        for k in sorted(self.axes, key=lambda k: k != GRADIENT):  # GRADIENT first: images along it are offset along FLOW
            boxes = np.floor(r[..., k] / self.lengths[k] + 0.5)
            out[..., k] = np.where(np.abs(boxes) < COUNTED, boxes, 0)
            if k == GRADIENT and FLOW in self.axes:
                r[..., FLOW] -= out[..., GRADIENT] * self.offset
        return out
