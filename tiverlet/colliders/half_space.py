"""A plane with particles on one side."""

from types import MappingProxyType

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device import ti
from ..features.feature import Knob, Scene
from ..geometry.intervals import entry, rounding, slab
from ..particles import Particles
from .collider import Collider


class HalfSpace(Collider):
    """Particles stay on the side of a plane to which the normal points: a floor, a slope.

    C(x) = n . x - offset - radius >= 0, grad C = n.

    normal: (dim,), any length above 0; offset: [m] along the unit normal, from the origin. offset is live: assign to it between
    frames, and the plane moves there during the next frame. friction, restitution, push_out, active, events, surface_velocity:
    see tiverlet/colliders/README.md.

    One-sided: a particle cannot pass at any speed, and no force can pull it through.
    """

    shares_code = True
    tracks = MappingProxyType({"offset": None})
    offset = Knob(
        lambda f, v: checks.number("HalfSpace", "offset", v), "Of the plane along its normal [m].",
        place=lambda f, offset, by: offset + float(np.dot(f.normal, by)),
    )  # fmt: skip

    def __init__(
        self, normal, offset: ArrayLike = 0.0, *, friction: ArrayLike = 0.0, restitution: ArrayLike = 0.0, push_out: float |
        None = None, active: bool | None = None, events: bool = False, surface_velocity=None,
    ):  # fmt: skip
        normal = np.asarray(normal, dtype=np.float64)
        normal = checks.vector("HalfSpace", "normal", normal, normal.size)
        self.normal = checks.direction(normal)
        if not self.normal.any():
            raise ValueError("HalfSpace: normal = 0 has no direction; (0, 1) is a floor.")
        self.normal.flags.writeable = False
        self.offset = offset
        self.set_surface(friction, restitution, push_out, active, events, surface_velocity=surface_velocity)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the dimension of the normal."""
        checks.vector("HalfSpace", "normal", self.normal, particles.dim)

    def bind(self, scene: Scene) -> None:
        """Declare the normal."""
        super().bind(scene)
        self.dev.normal = scene.memory.field("HalfSpace.normal", None, width=len(self.normal), values=self.normal)

    def outline(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
        """Return lines across the scene: one in 2D, two at right angles in 3D."""
        middle, reach = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
        foot = middle - (self.normal @ middle - self.offset) * self.normal
        across = np.linalg.svd(self.normal[None])[2][1:]  # an orthonormal basis of the plane
        return np.stack([foot - reach * across, foot + reach * across], axis=1), 0.0

    def solid(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a square of the plane, as wide as the scene."""
        if len(low) != 3:
            return Collider.solid(self, low, high)
        ends = self.outline(low, high)[0]
        corners = np.array([ends[0, 0], ends[1, 0], ends[0, 1], ends[1, 1]])
        return corners, np.array([[0, 1, 2], [0, 2, 3]])

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Return n . x - offset."""
        return points @ self.normal - self.place_of("offset")

    def cast(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances down to the plane, and its normal."""
        end = self.place_of("offset").item() + radius
        close = rounding(origin, np.array([[end]]))
        way = slab(origin @ self.normal, direction @ self.normal, -np.inf, end, close)
        return entry(way, close), np.tile(self.normal, (len(origin), 1))

    sides = 1  # type: ignore[assignment]

    @ti.func
    def least_gap(self, face, i, radius):
        """Return the gap at the higher one of the planes between which it moves."""
        higher = ti.max(self.dev.offset.ends[0][0], self.dev.offset.ends[1][0])
        return self.dev.normal[None].dot(self.dev.state.place(i)) - higher - radius

    @ti.func
    def gap(self, face, i, radius, frame_fraction, at_start: ti.template()):  # type: ignore[valid-type]
        """Return the gap to the plane."""
        n, before, now = self.dev.normal[None], self.dev.offset.at(frame_fraction[0])[0], self.dev.offset.at(frame_fraction[1])[0]
        gap = n.dot(self.dev.state.place(i))
        if ti.static(at_start):
            gap = gap - n.dot(self.dev.state.d[i]) - before - radius
        else:
            gap = gap - now - radius
        return gap, n, 0 * gap, (now - before) * n

    @ti.func
    def confine(self, i, radius, h, frame_fraction, mode):
        """Press the particle if it is below the plane."""
        n, before, now = self.dev.normal[None], self.dev.offset.at(frame_fraction[0])[0], self.dev.offset.at(frame_fraction[1])[0]
        depth, moved = now + radius - n.dot(self.dev.state.place(i)), (now - before) * n
        self.dev.surface.push(i, depth, depth + self.dev.surface.path(i, moved).dot(n), n, moved, h, mode, False)
