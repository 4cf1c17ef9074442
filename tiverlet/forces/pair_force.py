"""The user's own force between particles."""

from typing import Any

import numpy as np

from .. import checks
from ..device import inline, ti
from ..device.language import undecorated
from ..device.number import OnDevice
from ..features.feature import Acceleration, Scene
from ..features.regrouping import Regrouping
from ..features.user_function import check_function, check_number, check_vector
from ..neighbours.neighbour_search import NeighbourSearch

ROOM = (8, 40)  # initial room for listed neighbours per particle, in 2D and 3D; lists grow
SKIN = 0.15  # skin of the neighbour list, relative to the radius


class Cutoff:
    """The table that selects pairs for the neighbour search: all pairs closer than a radius."""

    uniform = True
    radius: Any = OnDevice()

    def __init__(self, scene: Scene, radius: float):
        self.radius = scene.memory.number(radius, scene.real)

    @inline
    def cutoff(self, radius, i, j):
        """Return the distance up to which particles i and j act on each other [m]."""
        return self.radius


class PairForce(Acceleration):
    """The user's own force between pairs of particles [N], such as charges or gravity: function(r) or function(r, i, j).

    function: a ti.func of r = x_i - x_j [m], and, if it names them, of the two indices, i < j. It returns the force on i as a
    vector [N]. The force on j is the opposite one, bit for bit, so momentum is conserved whatever the function is.
    radius: only pairs closer than this [m] act. A neighbour list finds them; it is rebuilt when a particle has moved by half of
    its skin. None for all pairs, which takes time as n^2.
    potential: a ti.func of the same arguments that returns the energy of the pair [J], 0 where the force ends, for the energy in
    reports. None leaves it out of them.

        @ti.func
        def repel(r, i, j):
            return charge[i] * charge[j] * r / r.norm() ** 3

        world = tv.World(particles, [tv.PairForce(repel)])

    The force acts at present positions, also between particles that are linked or touch. Particles in the same place do not act
    on each other, nor do two particles that cannot move. Sums are in the order of indices, so they have the same bits on any
    number of threads. Numbers that the function reads from Python are frozen when the world is first stepped; put changing
    numbers into a Taichi field.

    Position Verlet is second order in h while h times the fastest frequency of the motion stays below 2, and diverges beyond. The
    step then flags "stiff-force". A force that is not 0 at the radius jumps there, and makes energy drift.
    """

    pairwise = True
    uniform = True  # stiffness() measures its stiffness instead
    is_fixed_in_space = False
    host_only = ("radius",)

    def __init__(self, function, radius: float | None = None, *, potential=None):
        self.arity = check_function("PairForce", "function", function, ("r", "i", "j"), (1, 3))
        self.function: Any = function
        self.potential_of: Any = potential
        self.radius = None if radius is None else checks.number("PairForce", "radius", radius, above=0.0)
        self.potential_arity = 0
        if potential is not None:
            self.potential_arity = check_function("PairForce", "potential", potential, ("r", "i", "j"), (1, 3))
        self.listed = radius is not None

    @property
    def does_work(self) -> bool:
        """Whether the force may change the energy in reports, because no potential is given."""
        return not self.potential_arity

    def bind(self, scene: Scene) -> None:
        """Declare two fields of accelerations, now and in the substep before. make_search() declares the list."""
        self.scene, dev = scene, self.dev
        dev.state, dev.w, dev.real, dev.n = scene.state, scene.state.w, scene.real, scene.count
        dev.now = scene.memory.field("PairForce.acceleration", scene.count, width=self.dim, state=True)
        dev.last = scene.memory.field("PairForce.acceleration_before", scene.count, width=self.dim)

    def make_search(self, scene: Scene, team: Any) -> NeighbourSearch | None:
        """Declare the neighbour search and return it; None without a radius."""
        dev = self.dev
        dev.search = dev.list = None
        if self.radius is not None:
            dev.cutoff = Cutoff(scene, self.radius)
            none, half = np.zeros((0, 2), dtype=np.int32), self._half(scene.particles.count)
            dev.search = NeighbourSearch(scene, SKIN * self.radius, none, dev.cutoff, [], team, dev.last, radius=half)
            dev.list = dev.search.list
        return dev.search

    def _half(self, count: int) -> np.ndarray:
        """Return half of the radius for each of `count` particles [m], which lists take as particle radii."""
        return np.full(count, self.radius / 2)  # type: ignore[operator]

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether particles can come and go in place: not while the list is about to grow, or if the search would differ."""
        search = self.dev.search
        return search is None or (not search.list.saved and search.can_regroup(change, self._half(change.now.count)))

    def regroup(self, change: Regrouping) -> None:
        """Resize the neighbour search after particles came and went. The thread team already has the new number."""
        if self.dev.search:
            self.dev.search.regroup(change, SKIN * self.radius, self._half(change.now.count))  # type: ignore[operator]

    def kept_mask(self, number: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the mask of particles that remain: its fields have a row for each particle."""
        return (number >= 0,)

    @property
    def neighbours_per_particle(self) -> int:
        """Initial room for listed neighbours per particle."""
        return ROOM[self.dim - 2]

    @inline
    def force(self, *arguments):
        """Return the value of the function if it is a vector, else refuse it."""
        value = self.function(*arguments[: self.arity])
        return check_vector("PairForce", undecorated(self.function).__name__, value, self.dim)

    @inline
    def potential_energy(self, *arguments):
        """Return the value of the potential if it is a number, else refuse it."""
        value = self.potential_of(*arguments[: self.potential_arity])
        return check_number("PairForce", undecorated(self.potential_of).__name__, value)

    @ti.func
    def between(self, i, j, r):
        """Return the force of the function on particle i by particle j [N], for i < j and r = x_i - x_j."""
        out = 0 * r  # of the type of r, whatever the function returns
        out = self.force(r, i, j)
        return out

    @ti.func
    def near(self, r):
        """Whether two particles at the difference r act on each other: within the radius, and not in the same place."""
        rr = r.dot(r)
        out = rr > 0
        if ti.static(self.listed):
            out = out and rr < self.dev.cutoff.radius * self.dev.cutoff.radius
        return out

    @ti.func
    def pull(self, i, j, r):
        """Return the force on particle i by particle j [N], computed for the lower index. r = x_i - x_j."""
        out = 0 * r
        if self.near(r):
            if i < j:
                out = self.between(i, j, r)
            else:
                out = -self.between(j, i, -r)
        return out

    @ti.func
    def evaluate(self, i):
        """Compute the acceleration of particle i by all others, in order. Sums begin at +0, so what is listed changes no bit."""
        self.dev.last[i] = self.dev.now[i]
        total, w = ti.Vector.zero(self.dev.real, self.dim), self.dev.w[i]
        if w > 0:
            if ti.static(self.listed):
                for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
                    j = self.dev.list.neighbour[e]
                    total += self.pull(i, j, self.dev.state.separation(i, j))
            else:
                for j in range(self.dev.n.now):
                    if j != i:
                        total += self.pull(i, j, self.dev.state.separation(i, j))
        self.dev.now[i] = w * total

    @ti.func
    def acceleration(self, i, x, v, t):
        """Return the acceleration that evaluate() stored [m/s^2]."""
        return self.dev.now[i]

    @ti.func
    def stiffness_between(self, i, j):
        """Return omega^2 of a pair [1/s^2], (w_i + w_j) |F(r) - F(r - u)| / |u|, where r changed by u in the last substep."""
        r = self.dev.state.separation(i, j)
        u = self.dev.state.relative_displacement(self.dev.state.d[i] - self.dev.state.d[j], i, j)
        out, uu = 0 * r[0], u.norm_sqr()
        if uu > 0:
            out = (self.dev.w[i] + self.dev.w[j]) * (self.pull(i, j, r) - self.pull(i, j, r - u)).norm() / ti.sqrt(uu)
        return out

    @ti.func
    def stiffness(self, i):
        """Return an upper bound of omega^2 of particle i, the sum of stiffness_between() over its pairs [1/s^2]."""
        out = 0 * self.dev.now[i][0]
        if ti.static(self.listed):
            for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
                out += self.stiffness_between(i, self.dev.list.neighbour[e])
        else:
            for j in range(self.dev.n.now):
                if j != i:
                    out += self.stiffness_between(i, j)
        return out

    @ti.func
    def energy_between(self, i, j, back):
        """Return the share of particle i in the energy of a pair at x - back d, in f64 [J]: half, or all if j cannot move."""
        shift = back * self.dev.state.relative_displacement(self.dev.state.d[i] - self.dev.state.d[j], i, j)
        r = self.dev.state.separation(i, j) - shift
        out = ti.cast(0, ti.f64)
        if self.near(r):
            low, high = ti.min(i, j), ti.max(i, j)
            way = ti.select(i < j, r, -r)
            out = ti.cast(self.potential_energy(way, low, high), ti.f64)
            if self.dev.w[j] > 0:
                out *= 0.5
        return out

    @ti.func
    def energy(self, i, back):
        """Return the share of particle i in the energy of all pairs at x - back d, in f64 [J]."""
        out = ti.cast(0, ti.f64)
        if ti.static(self.listed):
            for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
                out += self.energy_between(i, self.dev.list.neighbour[e], back)
        else:
            for j in range(self.dev.n.now):
                if j != i:
                    out += self.energy_between(i, j, back)
        return out
