"""Periodic boxes: every particle has images, a box away along each periodic axis, and others meet the nearest of them."""

import contextlib
from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .. import checks
from ..features.feature import Feature, Knob, Scene
from ..features.regrouping import Regrouping
from .images import FLOW, GRADIENT, Images

if TYPE_CHECKING:
    from ..particles import Particles

AXES = "xyz"
SPARE = 2.2  # contact distances, that a sheared box is long at least
COUNTED = 2.0**62  # boxes


class Periodic(Feature):
    """A box that repeats without end along some axes: what leaves on one side is met on the other (periodic boundaries).

    low, high: corners of the box, (dim,) [m]; what stands there for other axes does not matter. axes: which are periodic, such as
    (0,) for x alone; None for all. shear: rate of a simple shear [1/s], of boxes without walls along x and y (Lees and Edwards
    1972): images one box further along y move along x at shear times the height of the box. Live.

    Contacts, links, angles and forces between particles act on the nearest image, r = x_i - x_j less whole boxes; it is unique
    within half a box, which no two particles in contact, no PairForce and no link may exceed. world.position stays **unwrapped**:
    a particle that leaves goes on, nothing jumps, and its mean square displacement is one of positions. `wrap(position)` says
    where particles are in the box; recordings draw them there. What acts on places acts on unwrapped ones (Pin, Path, Attractor,
    Force); walls and obstacles act on the box: HalfSpace and Box only along other axes; a Ball or a Capsule on the image of a
    particle that is nearest to its middle; a Polygon, Mesh or Sdf on that in the box, so it may not reach out of it.

    In f32 the digits of a coordinate end at 6e-8 of it: particles that wander off by 100 boxes are known to 1e-5 of a box. Where
    they do, in a flow or a long shear, take "f64" or "f32-compensated".

    With shear, velocities are those of the unwrapped motion: of a linear profile v_x = shear y, whatever the box. Walls and
    obstacles have no place in it. Drag and Wind slow the flow itself. The list of neighbours takes account of the strain.

    Raises ValueError for a box that is too small for what is in it. A world has at most one.
    """

    compiled_for = ("sheared",)
    host_only = ("low", "high")
    _last = 0.0, 0.0
    shear = Knob(lambda f, v: checks.number("Periodic", "shear", v), "Rate of the shear [1/s].")
    code_size = 0.1

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
        """Check the dimension, and that a shear has both of its axes."""
        if len(self.low) != particles.dim:
            raise ValueError(f"Periodic: low has {len(self.low)} coordinates, but the particles are in {particles.dim}D.")
        if self.sheared and not {FLOW, GRADIENT} <= set(self.axes):
            raise ValueError(f"Periodic: shear = {self.shear:g} needs a box that is periodic along x and y, not {self.axes}.")

    @property
    def does_work(self) -> bool:
        """Whether images move."""
        return self.shear != 0

    @property
    def sheared(self) -> bool:
        """Whether there is a shear, or was when kernels were compiled."""
        return self.shear != 0 or "sheared" in self.compiled_so_far

    @property
    def lengths(self) -> np.ndarray:
        """Of the box along each axis, (dim,) [m]; inf along those that are not periodic."""
        some = np.isin(np.arange(len(self.low)), self.axes)
        return np.where(some, np.where(some, self.high, 1.0) - np.where(some, self.low, 0.0), np.inf)

    @property
    def middle(self) -> np.ndarray:
        """Of the box, (dim,) [m]; 0 along axes that are not periodic."""
        some = np.isfinite(self.lengths)
        return (np.where(some, self.low, 0.0) + np.where(some, self.high, 0.0)) / 2

    @property
    def shortest(self) -> float:
        """The shortest side along a periodic axis [m]."""
        return float(self.lengths.min())

    def refuse(self, who: str, what: str, far: float, smaller: str, half: bool = False) -> None:
        """Raise ValueError for what reaches further than half a box; or just so far, where `half`. Where images slide, lists need
        room for their skin."""
        k, least = int(np.argmin(self.lengths)), (SPARE if self.sheared else 2) * far
        if least > self.shortest or (half and least == self.shortest):
            raise ValueError(
                f"Periodic: along {AXES[k]} the box is {self.shortest:g} m long, but {who}: {what} up to {far:g} m apart, and "
                f"would meet two images of the same particle. Make the box longer than {least:g} m there, or {smaller} smaller."
            )

    @property
    def strain(self) -> float:
        """How far the shear has come: the integral of its rate."""
        return self._come[0]

    @property
    def _come(self) -> tuple[float, float]:
        """The strain, and where the image one box further along y is along x [m]."""
        images = vars(self.dev).get("images")
        if images and images.sheared:
            with contextlib.suppress(RuntimeError):  # there is none before its world is complete, nor after it is closed
                read = self.scene.memory.read
                self._last = float(read(images.strain)[0]), float(read(images.shift)[0, 0])
        return self._last

    def continued(self, other: "Periodic") -> None:
        """Take over the strain of the same box in another world."""
        if self.dev.images.sheared:
            strain, offset = other._come
            self.scene.memory.write(self.dev.images.strain, strain)
            self.scene.memory.write(self.dev.images.shift, [offset, 0.0])

    def copy(self) -> "Periodic":
        """Without the strain, which belongs to a world."""
        new: Any = super().copy()
        new._last = 0.0, 0.0
        return new

    def release(self) -> None:
        """What is found out while the world is built anew is found out where images are now."""
        self._last = self._come
        super().release()

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether the widest particle, which has to fit in, is as wide as before."""
        return change.now.radius.max(initial=0.0) == change.before.radius.max(initial=0.0)

    def bind(self, scene: Scene) -> None:
        """Lengths, and where images are."""
        self.scene, scene.periodic = scene, self
        self.dev.images = scene.state.images = Images(scene, self)
        self.changed = False

    def upload(self) -> None:
        """Write the rate."""
        if self.dev.images.sheared:
            self.scene.memory.write(self.dev.images.rate, self.shear)

    # Where images are, in NumPy.

    @property
    def offset(self) -> float:
        """How far along x the image is that is one box further along y [m]."""
        return self._come[1]

    def outline(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """For pictures of a scene between two corners: the edges of the box, (m, 2, dim); along axes that are not periodic it
        ends with the scene."""
        some = np.isfinite(self.lengths)
        ends = np.stack([np.where(some, self.low, low), np.where(some, self.high, high)])
        corners = np.array(list(product((0, 1), repeat=len(some))))
        pairs = [(a, b) for a in corners for b in corners if (b - a).sum() == 1 and (b >= a).all()]
        return np.array([[ends[a, range(len(a))], ends[b, range(len(b))]] for a, b in pairs])

    def boxes(self, position: ArrayLike) -> np.ndarray:
        """How many boxes along each axis positions (n, dim) are away from the box, (n, dim) integers: the image flags of LAMMPS.

        With shear, the velocity of the image in the box is v_x - boxes[:, 1] * shear * height.
        """
        return self._turns(np.asarray(position, dtype=np.float64) - self.middle)

    def wrap(self, position: ArrayLike) -> np.ndarray:
        """Where positions (n, dim) [m] are in the box: low <= x < high, up to rounding, along periodic axes."""
        x = np.asarray(position, dtype=np.float64)
        return x - self.away(self.boxes(x))

    def difference(self, a: ArrayLike, b: ArrayLike) -> np.ndarray:
        """a - b between nearest images [m], for arrays (..., dim) of positions."""
        r = np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)
        return r - self.away(self._turns(r))

    def away(self, boxes: ArrayLike) -> np.ndarray:
        """How far so many boxes along each axis are [m], (..., dim)."""
        boxes = np.asarray(boxes)
        out = np.asarray(boxes * np.where(np.isfinite(self.lengths), self.lengths, 0.0))
        out[..., FLOW] += boxes[..., GRADIENT] * self.offset
        return out

    def ghosts(self, position: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """Images of particles within `reach` [m] of the box: their numbers, and where they are; first those in it, in order."""
        x = self.wrap(position)
        found, places = [np.arange(len(x))], [x]
        along = 2 if self.offset else 1  # the next box along y begins anywhere along x
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

    def _turns(self, r: np.ndarray) -> np.ndarray:
        """How many boxes along each axis are nearest to r; none where that is no number, or too many to be counted."""
        out = np.zeros(r.shape, dtype=np.int64)

        def count(k: int) -> None:
            """Along axis k."""
            boxes = np.floor(r[..., k] / self.lengths[k] + 0.5)
            out[..., k] = np.where(np.abs(boxes) < COUNTED, boxes, 0)

        if FLOW in self.axes and GRADIENT in self.axes:
            count(GRADIENT)
            r = r.copy()
            r[..., FLOW] -= out[..., GRADIENT] * self.offset
        for k in self.axes:
            count(k)
        return out
