"""Particles as the user specifies them: checked arrays."""

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..features.read_only import read_only, structure_advice
from ..features.unknown_names import answer_names, no_attribute

LARGEST = 1e15  # [m] squared lengths up to 1e30 leave room below the largest f32, 3e38


@answer_names
@checks.answer_calls
class Particles:
    """n point masses with optional radii: the initial state of a world, and its structure.

    position: (n, dim) [m], dim 2 or 3; n = 0 is allowed.
    velocity: 0, (dim,) or (n, dim) [m/s].
    mass: number or (n,) [kg], above 0; inf makes a particle static: nothing moves it.
    radius: number or (n,) [m], at least 0. A point (radius 0) touches discs and walls but not other points.
    pinned: indices or a Boolean mask of particles that stay in place, whatever their mass.
    group: integer or (n,), for contact filters.
    spin: whether friction turns them, so that they roll, see Contact. False, the default: they slide, and nothing is computed for
    spin. True: they turn, from rest. Or the angular velocity [rad/s] with which they begin: a number or (n,) in 2D,
    counterclockwise; 0, (3,) or (n, 3) in 3D. A particle that cannot move (pinned, or of infinite mass) keeps its spin, as a
    driven roller does.
    inertia: moment of inertia in units of mass radius^2: "disc" (1/2; the default in 2D), "ring" (1), "sphere" (2/5; the default
    in 3D), "shell" (2/3), or a number or (n,), above 0; inf for particles that friction does not turn.
    orientation: initial orientation: an angle or (n,) in 2D [rad]; 0, (4,) or (n, 4) unit quaternions (x, y, z, w) in 3D. Without
    it, orientations are not tracked.

    Raises ValueError or TypeError naming the first invalid index. The arrays are read-only: mass, radius and links are structure,
    fixed when a world is built. To move particles, assign to world.position and world.velocity.
    """

    kernels_read = ("dim",)

    def __init__(
        self, position: ArrayLike, *, velocity: ArrayLike = 0.0, mass: ArrayLike = 1.0, radius: ArrayLike = 0.0,
        pinned: ArrayLike = (), group: ArrayLike = 0, spin: ArrayLike | None = None, inertia: str | ArrayLike | None = None,
        orientation: ArrayLike | None = None,
    ):  # fmt: skip
        who = "Particles"
        self.position = checks.points(who, "position", position)
        self.count, self.dim = self.position.shape
        in_range(who, "position", self.position)
        self.velocity = _vectors(who, "velocity", velocity, self.position.shape, "direction")
        self.mass = checks.per_item(who, "mass", mass, self.count, above=0.0, infinite=True)
        self.radius = checks.per_item(who, "radius", radius, self.count, least=0.0)
        self.pinned = _pinned(who, pinned, self.count)
        self.group = _group(who, group, self.count)
        self.spin, self.inertia, self.orientation = turning(self, spin, inertia, orientation)
        with np.errstate(divide="ignore"):
            self.inv_mass = np.where(self.pinned, 0.0, 1.0 / self.mass)
        self._fix()

    def _fix(self) -> None:
        """Make all attributes read-only."""
        for name, array in vars(self).items():
            if isinstance(array, np.ndarray):
                vars(self)[name] = _fixed(name, array)
        self._fixed = True

    @property
    def size(self) -> float:
        """A typical length of the scene [m], for relative residuals of constraints without a length of their own."""
        return max(self.extent) or float(self.radius.max(initial=0.0)) or 1.0

    @property
    def extent(self) -> list[float]:
        """The size of the bounding box of all centers [m]. Axis by axis: NumPy is ten times as fast as with all axes at once."""
        columns = np.ascontiguousarray(np.asarray(self.position).T)
        return [float(x.max() - x.min()) if self.count else 0.0 for x in columns]

    @property
    def axes(self) -> int:
        """The number of axes of rotation: 1 in 2D, 3 in 3D."""
        return 2 * self.dim - 3

    @property
    def spins(self) -> bool:
        """Whether particles spin."""
        return self.spin is not None

    def regrouped(self, some: np.ndarray, added: "Particles | None" = None, position: np.ndarray | None = None) -> "Particles":
        """Return the particles in the mask `some`, then the `added` ones. position: of the old ones, (n, dim) [m], or None."""
        names, own = ("velocity", "mass", "radius", "pinned", "group", "inv_mass"), vars(self)
        both: dict[str, np.ndarray] = {"position": self.position if position is None else position}
        both |= {name: own[name] for name in names}
        if not some.all():
            stay = np.flatnonzero(some)
            both |= {name: values.take(stay, axis=0) for name, values in both.items() if position is None or name != "position"}
        if added is not None:
            both = {name: np.concatenate([values, vars(added)[name]]) for name, values in both.items()}
        new = object.__new__(Particles)  # without __init__: all values were checked before
        vars(new).update(both, count=len(both["position"]), dim=self.dim)
        vars(new).update(self._turning_of(some, added))
        new._fix()
        return new

    def placed(self, position: np.ndarray) -> "Particles":
        """Return the same particles at other positions, (n, dim) [m]."""
        new = object.__new__(Particles)
        vars(new).update(vars(self), position=_fixed("position", position))
        return new

    def _turning_of(self, some: np.ndarray, added: "Particles | None") -> dict[str, np.ndarray | None]:
        """Return spin, inertia and orientation of particles in the mask and of added ones, which rest if only the others spin."""
        groups = [(self, some), *([(added, np.ones(len(added), dtype=bool))] if added is not None else [])]
        if not any(p.spins for p, _ in groups):
            return dict.fromkeys(TURNING)
        out: dict[str, np.ndarray | None] = {}
        for name in TURNING:
            given = [getattr(p, name) for p, _ in groups]
            rows = [at_rest(name, p) if v is None else v for (p, _), v in zip(groups, given, strict=True)]
            there = any(p.spins if name != "orientation" else p.orientation is not None for p, _ in groups)
            out[name] = np.concatenate([v[mask] for v, (_, mask) in zip(rows, groups, strict=True)]) if there else None
        return out

    def __setattr__(self, name: str, value) -> None:
        if getattr(self, "_fixed", False):
            if not hasattr(self, name):
                raise no_attribute(self, name)
            raise AttributeError(
                f"Particles.{name} is structure, fixed when a world is built. Make new Particles for a new world; "
                "to move particles assign to world.position or world.velocity."
            )
        object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return self.count

    def __repr__(self) -> str:
        return f"Particles({self.count} in {self.dim}D)"


def _fixed(name: str, array: np.ndarray) -> np.ndarray:
    """Make an array of Particles read-only."""
    live = f" To move particles, assign to world.{name}." if name in ("position", "velocity") else ""
    return read_only(array, structure_advice("Particles", name) + live)


def in_range(who: str, name: str, position: np.ndarray) -> None:
    """Raise ValueError for coordinates above LARGEST, whose squares might overflow in f32."""
    few = position.size <= checks.FEW
    if (max(map(abs, position.ravel().tolist()), default=0.0) if few else np.abs(position).max(initial=0.0)) > LARGEST:
        far = np.abs(position) > LARGEST
        i, k = np.unravel_index(int(np.argmax(far)), far.shape)
        raise ValueError(
            f"{who}: {name}[{i}, {k}] = {position[i, k]:g} m is out of range (at most {LARGEST:g} m). "
            "Shift the scene towards the origin or use larger units."
        )


TURNING = ("spin", "inertia", "orientation")
BODIES = {"disc": 0.5, "ring": 1.0, "sphere": 0.4, "shell": 2 / 3}  # I / (m r^2)


def at_rest(name: str, particles: "Particles") -> np.ndarray:
    """Return the default of an attribute in TURNING: no spin, the inertia of discs or spheres, not turned."""
    n, flat = particles.count, particles.dim == 2
    if name == "spin":
        return np.zeros(n) if flat else np.zeros((n, 3))
    if name == "inertia":
        return np.full(n, BODIES["disc" if flat else "sphere"])
    return np.zeros(n) if flat else np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))


def turning(particles: "Particles", spin, inertia, orientation) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
    """Return the checked arguments in TURNING for each particle; None for those that are absent."""
    who, n = "Particles", particles.count
    if isinstance(spin, (bool, np.bool_)):
        given = "inertia" if inertia is not None else "orientation" if orientation is not None else ""
        if given and not spin:
            raise ValueError(f"{who}: spin = False, but {given} is for particles that turn. Leave one of them out.")
        spin = 0.0 if spin else None
    if spin is None and inertia is None and orientation is None:
        return None, None, None
    rates = at_rest("spin", particles) if spin is None else spin_of(who, spin, particles)
    if isinstance(inertia, str):
        if inertia not in BODIES:
            raise ValueError(f"{who}: inertia = {inertia!r}, but it must be a number or one of {', '.join(map(repr, BODIES))}.")
        inertia = BODIES[inertia]
    shares = at_rest("inertia", particles)
    if inertia is not None:
        shares = checks.per_item(who, "inertia", inertia, n, above=0.0, infinite=True)
    return rates, shares, None if orientation is None else orientation_of(who, orientation, particles)


def spin_of(who: str, spin, particles: "Particles") -> np.ndarray:
    """Return checked angular velocities: (n,) in 2D, (n, 3) in 3D [rad/s]. Points must not spin."""
    n = particles.count
    if particles.dim == 2:
        rates = checks.per_item(who, "spin", spin, n)
    else:
        rates = _vectors(who, "spin", spin, (n, 3), f"axis. Give (0, 0, {spin}), for example")
    turned = (rates != 0).reshape(n, particles.axes).any(axis=1) & (particles.radius == 0)
    if turned.any():
        i = int(np.argmax(turned))
        raise ValueError(f"{who}: spin[{i}] = {rates[i]}, but particle {i} is a point (radius 0), which does not spin.")
    return np.array(rates)


def orientation_of(who: str, orientation, particles: "Particles") -> np.ndarray:
    """Return checked orientations: angles (n,) in 2D [rad], unit quaternions (n, 4) in 3D."""
    n, zero = particles.count, at_rest("orientation", particles)
    if particles.dim == 2:
        return np.array(checks.per_item(who, "orientation", orientation, n))
    array = checks.plain(who, "orientation", orientation)
    if array.ndim == 0:
        if float(checks.number(who, "orientation", orientation)) != 0:
            raise ValueError(f"{who}: orientation = {orientation}, but 0 or unit quaternions (x, y, z, w) are needed in 3D.")
        return zero
    if array.shape not in ((4,), (n, 4)):
        raise ValueError(f"{who}: orientation has shape {array.shape}, but (4,) or ({n}, 4) is needed, quaternions (x, y, z, w).")
    turned = np.broadcast_to(np.asarray(array, dtype=np.float64), (n, 4)).copy()
    checks.finite(who, "orientation", turned)
    length = np.linalg.norm(turned, axis=1)
    if (abs(length - 1) > 1e-3).any():
        i = int(np.argmax(abs(length - 1)))
        raise ValueError(f"{who}: orientation[{i}] = {turned[i]} has length {length[i]:g}; a unit quaternion has 1.")
    return turned / length[:, None]


def _vectors(who: str, name: str, value, shape: tuple[int, int], lacks: str) -> np.ndarray:
    """Return vectors, one for each particle, of 0, (dim,) or (n, dim). lacks: what a single number has none of."""
    array = checks.plain(who, name, value)
    if array.ndim == 0:
        if float(checks.number(who, name, value)) != 0:
            raise ValueError(f"{who}: {name} = {value}; a single number other than 0 has no {lacks}.")
        return np.zeros(shape)
    if array.ndim == 1 and array.shape != (0,):
        return np.broadcast_to(checks.vector(who, name, value, shape[1]), shape).copy()
    return checks.points(who, name, value, dim=shape[1], count=shape[0])


def _group(who: str, group, count: int) -> np.ndarray:
    array = checks.plain(who, "group", group)
    if array.shape not in ((), (count,)):
        raise ValueError(f"{who}: group has shape {array.shape}, but an integer or an array of shape ({count},) is needed.")
    if array.dtype.kind not in "iu" and count:
        raise TypeError(f"{who}: group has type {array.dtype}, but integers are needed.")
    return np.broadcast_to(array, (count,)).copy()


def _pinned(who: str, pinned, count: int) -> np.ndarray:
    array = checks.plain(who, "pinned", pinned if pinned is not None else ())  # as many libraries write "none"
    if array.dtype == bool:
        if array.shape != (count,):
            raise ValueError(f"{who}: pinned has shape {array.shape}, but a mask of shape ({count},) is needed.")
        return array.copy()
    mask = np.zeros(count, dtype=bool)
    mask[checks.indices(who, "pinned", array, count)] = True
    return mask
