"""Clusters of particles that keep their shape."""

from typing import Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device.interrupts import in_turn
from ..features.feature import Batch, Knob, Scene
from ..features.flag import BREAKS, SOFT, Flag
from ..geometry.ordered import distinct
from ..particles import Particles
from .core.cluster_passes import ClusterPasses
from .core.members import Members, rows
from .core.spring import SOFTEST, bears_nothing, per_newton
from .core.strength import strength_of


class ShapeMatch(Batch):
    """Clusters that keep their shape: rigid bodies, or soft bodies that spring back (after Mueller et al. 2005).

    C_i(x) = x_i - (c + R q_i) for each particle of a cluster, with the rest shape q, and the center c and rotation R of the
    cluster.

    Rigid clusters keep momentum and angular momentum, are second order and undamped (Moser and Veselov 1991).
    A rotation of more than 41 degrees in a substep has the flag "turned".

    In soft clusters, a spring pulls each particle to its place, by its share of the mass: all deformations of a cluster of mass M
    have the frequency sqrt(1 / (compliance M)). Damping acts on the deformation alone.

    clusters: a sequence of index sequences, or (m, k), or one sequence. They may overlap: each pass then moves a particle to the
    mean of its places in them, so rigid lattices give way under loads, as rigid links do under Jacobi. A cluster may be flat, on
    a line, in one place or inside out; it is rotated, never reflected.
    rest: (n, dim) [m], the rest shape of all particles; None takes the initial positions.
    compliance: number or (m,) [m/N]; the stiffnesses of a cluster's springs add up to 1 / compliance. 0 is rigid.
    damping: number or (m,) [N s/m], the sum of the dashpots parallel to the springs.
    creep: number or (m,) [1/s], plastic flow: rate at which the rest shape follows the deformation that exceeds yield_strain.
    yield_strain: number or (m,), displacement of a particle without flow, relative to the cluster's radius.
    break_at: force on one of its particles at which a cluster falls apart, number or (m,) [N]; None for never.

    `load` is the largest force on a particle of each cluster [N], m omega^2 r where it spins freely.

    In f32, rounding changes the angular momentum by 3e-8 of itself in a substep, at random; "f64" avoids it.
    """

    host_only = ("_radius", "_rest", "_shape")

    clusters = True
    answers_alone = True
    each = ("compliance", "damping", "creep", "yield_strain", "break_at")
    index_name = "clusters"
    compliance: Any = Knob(lambda f, v: f._setting("compliance", v), "Inverse stiffness [m/N], (m,).", force=True)
    damping: Any = Knob(lambda f, v: f._setting("damping", v), "Of the dashpots [N s/m], (m,).", force=True)
    creep: Any = Knob(lambda f, v: f._setting("creep", v), "Rate of flow [1/s], (m,).")
    yield_strain: Any = Knob(lambda f, v: f._setting("yield_strain", v), "Strain without flow, (m,).")
    break_at: Any = Knob(strength_of, "Load beyond which a constraint breaks, (m,); None for never.")
    compiled_for = ("soft", "transcends", "breaks")
    soft, breaks = SOFT, BREAKS
    transcends = Flag(lambda f: (f.creep > 0).any(), "Whether any cluster flows, at an exponential rate.")

    def __init__(
        self, clusters, rest=None, *, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0, creep: ArrayLike = 0.0, yield_strain:
        ArrayLike = 0.0, break_at=None,
    ):  # fmt: skip
        self.members = Members.joined("ShapeMatch", rows("ShapeMatch", "clusters", clusters, 1))
        self._rest = None if rest is None else checks.points("ShapeMatch", "rest", rest)
        self.compliance, self.damping, self.creep, self.yield_strain = compliance, damping, creep, yield_strain
        self.break_at = break_at

    def _setting(self, name: str, value) -> np.ndarray:
        most = SOFTEST if name == "compliance" else None
        value = checks.per_item(repr(self), name, value, self.count, least=0.0, most=most)
        now = {"compliance": 1.0, "creep": 0.0} | vars(self) | {name: value}
        rigid = (now["creep"] > 0) & (now["compliance"] == 0) & np.ones(self.count, dtype=bool)
        if rigid.any():
            k = int(np.argmax(rigid))
            raise ValueError(
                f"{self!r}: creep[{k}] = {now['creep'][k]:g}, but a rigid cluster does not flow; give it compliance."
            )
        return value

    def upload(self) -> None:
        """Write new stiffnesses, rates and strengths to the device."""
        if self.acts:
            write = self.scene.memory.write
            self._forget_springs()
            self.dev.spring.upload(self.compliance, self.damping)
            if self.dev.plastic:
                write(self.dev.creep, self.creep)
                write(self.dev.yield_size, self.yield_strain * self._radius)
            self.dev.strength.upload(self.break_at)

    def _forget_springs(self) -> None:
        """Let clusters that become rigid forget what their springs bore: they are put into shape, however soft they were."""
        spring, read = self.dev.spring, self.scene.memory.read
        if spring.soft and (stiffened := (read(spring.alpha)[: self.count] > 0) & (self.compliance == 0)).any():
            pull = read(self.dev.pull)
            pull[: len(self.owner)][stiffened[self.owner]] = 0.0
            self.scene.memory.write(self.dev.pull, pull)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Compute the rest shapes, each about its center of mass."""
        self.members.check(repr(self), "clusters", particles.count)
        rest = particles.position
        if self._rest is not None:
            rest = checks.points(repr(self), "rest", self._rest, dim=particles.dim, count=particles.count)
        q = rest[self.indices]
        m = np.where(np.isfinite(particles.mass), particles.mass, 1.0)[self.indices]
        total = np.bincount(self.members.owner, weights=m, minlength=self.count)
        center = np.stack([np.bincount(self.members.owner, weights=m * x, minlength=self.count) / total for x in q.T], axis=1)
        self._shape = q - center[self.members.owner]
        square = np.bincount(self.members.owner, weights=m * (self._shape**2).sum(axis=1), minlength=self.count)
        self._radius = np.sqrt(square / total)

    @property
    def can_extend(self) -> bool:
        """Whether more clusters can be appended: not where `rest` was given, which has a row for every particle."""
        return self._rest is None

    def set_listing(self, listing: Any) -> None:
        """Replace the clusters by these."""
        self._keep(members=Members.joined("ShapeMatch", listing))

    def shape_of(self, c: int) -> np.ndarray:
        """Return the rest shape of cluster c about its center, (k, dim)."""
        return self._shape[self.members.starts[c] : self.members.starts[c + 1]]

    def remap_indices(self, number: np.ndarray, count: int) -> None:
        """Renumber the particles. Rows of `rest` for particles added later are 0; no cluster uses them."""
        super().remap_indices(number, count)
        if self._rest is not None:
            rest = np.zeros((count, self._rest.shape[1]))
            rest[number[number >= 0]] = self._rest[number >= 0]
            self._rest = rest
            self.arguments = {**self.arguments, "rest": rest}

    def excluded_pairs(self, particles: Particles) -> np.ndarray:
        """Return pairs of the same cluster that may overlap: neighbours only. Others cannot meet unless the cluster is soft."""
        sizes, out = np.diff(self.members.starts), [np.zeros((0, 2), dtype=np.int32)]
        for size in distinct(sizes)[0].tolist():
            first = self.members.starts[:-1][sizes == size]
            out.append(_near(np.asarray(self.indices)[first[:, None] + np.arange(size)], particles))
        return np.concatenate(out)

    def passes(self, scene: Scene) -> ClusterPasses:
        """Make the passes over clusters."""
        return ClusterPasses(scene, self, self._shape, self._radius)

    def bind(self, scene: Scene) -> None:
        """Declare fields for the shapes and rotations of the clusters."""
        super().bind(scene)
        self.changed = False

    @property
    @in_turn
    def load(self) -> np.ndarray:
        """The largest force on a particle of each cluster during the last substep [N], (m,)."""
        if bears_nothing(self):
            return np.zeros(self.count)
        w = self.scene.inv_mass[self.indices]
        mass = self.scene.memory.read(self.dev.mass)
        weights = np.divide(1.0, mass, out=np.zeros(self.count), where=mass > 0)
        firm = per_newton(self.scene.multipliers_per_newton, self.compliance, lambda: weights)
        scale = np.divide(firm[self.owner], w, out=np.zeros_like(w), where=w > 0)
        pull = self.scene.memory.read(self.dev.pull).astype(np.float64)
        return np.maximum.reduceat(scale * np.linalg.norm(pull, axis=1), self.members.starts[:-1])


def _near(members: np.ndarray, particles: Particles) -> np.ndarray:
    """Return pairs of members of the same cluster less than 3 radii apart. members: of clusters of k particles, (m, k)."""
    x, r = particles.position[members], particles.radius[members]
    out = [np.zeros((0, 2), dtype=np.int32)]
    for k in range(members.shape[1] - 1):
        near = ((x[:, k + 1 :] - x[:, k : k + 1]) ** 2).sum(axis=2) < (1.5 * (r[:, k + 1 :] + r[:, k : k + 1])) ** 2
        c, j = np.nonzero(near)
        out.append(np.stack([members[c, k], members[c, k + 1 + j]], axis=1))
    return np.concatenate(out).astype(np.int32)
