"""Known loads: each pair learns the load that it bears at rest, and applies it in every substep like a force."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..features.feature import Acceleration
from ..features.learning import SteadyMotion, is_steady, learnt_share
from ..geometry import rotation
from ..neighbours.neighbour_list import PairData
from ..neighbours.queries import between

if TYPE_CHECKING:
    from ..features.feature import Scene
    from ..neighbours.neighbour_list import NeighbourList

WINDOW = 128  # substeps over which the missing load is averaged
SLOW_BODIES = 1.2  # substeps that it takes to learn the load of k particles, per k^2
LAG_BODIES = 448  # further substeps that bodies take to learn any load, so that no step makes them swing beyond their height
SAME = 1e-3  # relative change of the vector between a pair beyond which it forgets its load when positions are assigned


class Carried(Acceleration):
    """The acceleration of particles by the known loads of their contacts [m/s^2], as one more force. field: (n, dim)."""

    uniform = True  # no stiffness: it does not depend on positions within a substep

    def __init__(self, scene: "Scene"):
        self.field = scene.memory.field("Contact.carried", scene.count, width=scene.particles.dim, state=True)

    @ti.func
    def acceleration(self, i, x, v, t):
        """Return the acceleration of particle i by its known loads."""
        return self.field[i]


class LearntLoad:
    """The data of one load that each pair learns: along the normal, where it only `pushes`, or across it."""

    def __init__(self, names: tuple[str, str, str], pushes: bool):
        self.pushes = pushes
        self.load, self.borne, self.earlier = self.pair_data = [PairData(name, 0, persistent=True) for name in names]


class KnownLoads:
    """The known loads of Polygons: each pair stores the load F [N] that it bears, and applies it in every substep like a force.

    The force acts before contacts are detected. Contacts add the missing part. They may take back a part of F, but never pull. F
    acts along the normal of the pair at the end of the last substep, where the next one starts, so it has no moment.

    One pass per substep holds a load by an overlap, 2 k g h^2 for the k-th contact of a column. A known load needs no overlap. F
    is learnt gradually, which is integral control. If contacts added `mean` on average over a window, within a fifth of what they
    added in the window before, F += gain mean. Within a substep F is constant, so stability is the same as without.

    Learning must be slower than the slowest mode decays. Columns of N bodies swing, and it decays in 3 N^2 substeps, with k = 2 N
    for the number k = F / (m g) of particles that a pair bears: s^2 + L s + L (1 + K / s) = 0 is stable where the share K learnt
    in a substep is below L = 2.7 / k^2, and K = 1 / (SLOW_BODIES k^2). An impact has a large k, so it is not learnt.

    A pair with no push at the end of a pass, because its particles parted or bounced, forgets its load at once. Restitution
    decides by the overlap of a pair whether it rests; for a known load, the overlap that would hold it is added.

    The vertex stores F, which acts on it and, by shares 1 - t and t, on the ends of the edge. Contacts also know F_t, which
    friction holds across the normal, see Polygons.learn_friction(). See SteadyMotion and WallLoads, too.

    has_friction: whether they learn what friction holds.

    Warm starting (Box2D) of a single pass would be unstable: a mode of eigenvalue L has the characteristic polynomial
    z^3 - 3 a z^2 + 3 a z - a, a = 1 - r L, whose roots near 1 grow like (r L)^(1/3) / 2.
    """

    def __init__(self, scene: "Scene", has_friction: bool):
        self.state, self.weights = scene.state, scene.own_weight
        # The load [N], the sum of its missing part in this window [kg m], and the mean of it in the window before [N].
        self.normal = LearntLoad(("load", "borne", "earlier"), True)
        self.load, self.borne = self.normal.load, self.normal.borne
        self.friction: Any = LearntLoad(("rub", "rubbed", "rubbed_earlier"), False) if has_friction else None
        self.pair_data = [*self.normal.pair_data, *(self.friction.pair_data if self.friction else [])]
        self.carried, self.motion = Carried(scene), SteadyMotion(scene)
        self.in_state = {"carried": self.carried.field, "velocity": self.motion.velocity}

    def bind(self, pairs: "NeighbourList", geometry: Any) -> None:
        """Store the neighbour list, which holds the pair data, and the geometry of contacts."""
        self.list, self.geometry = pairs, geometry

    def forget(self, scene: "Scene", x: np.ndarray) -> None:
        """Clear the loads of pairs whose relative position changes, before particles are moved to x (n, dim) [m]."""
        pairs, values = self.list.persistent_data()
        if not values["load"].any():
            return
        who = self.geometry.members(pairs)
        old, one, others = scene.state.get(scene.memory), who[:, :1], who[:, 1:]
        before = between(old[one], old[others], scene.periodic)
        way = np.linalg.norm(between(x[one], x[others], scene.periodic) - before, axis=2)
        moved = (way > SAME * np.linalg.norm(before, axis=2)).any(axis=1)
        for piece in self.pair_data:
            values[piece.name][moved] = 0.0
        self.list.restore(pairs, values)
        self.carry(scene, x, pairs, values)

    def carry(self, scene: "Scene", x: np.ndarray, pairs: np.ndarray, values: dict[str, np.ndarray]) -> None:
        """Set the accelerations of particles at x (n, dim) [m] by the loads of pairs (m, 2).

        values: as returned by NeighbourList.persistent_data().
        """
        n, total = self.geometry.gradients(x, pairs), np.zeros_like(x)
        force = n * values["load"][:, None, None]
        if self.friction:
            force += np.stack([-n[..., 1], n[..., 0]], axis=-1) * values["rub"][:, None, None]
        for who, each in zip(self.geometry.members(pairs).T, np.moveaxis(force, 1, 0), strict=True):
            total += np.stack([np.bincount(who, column, minlength=len(x)) for column in each.T], axis=1)
        scene.memory.write(self.carried.field, scene.inv_mass[:, None] * total)

    @ti.func
    def known_push(self, e, now):
        """Return what the known load of entry e gave in this substep, per inverse mass [kg m]."""
        return self.load.field[e] * self.weights.integrator.h2_effective(now.h, now.fresh)

    @ti.func
    def known_friction(self, e, now):
        """Return the same of the load across the normal, which friction holds."""
        return self.friction.load.field[e] * self.weights.integrator.h2_effective(now.h, now.fresh)

    @ti.func
    def force(self, e, n):
        """Return the known force of entry e, with the normal n [N]."""
        out = self.load.field[e] * n
        if ti.static(bool(self.friction)):
            out += self.friction.load.field[e] * rotation.across(n)
        return out

    @ti.func
    def update_load(self, i, j, e, part, push, now):
        """Update the load of entry e, the pair of i and j, and return it [N].

        part: the push that contacts added in this pass [kg m]. push: the whole push of the pair [kg m].
        """
        return self.update(self.normal, i, j, e, part, push > 0, now)

    @ti.func
    def update(self, of: ti.template(), i, j, e, part, bears, now):  # type: ignore[valid-type]
        """Update one load of entry e, of which a pass added `part`, and return it [N]. bears: whether the pair bears any load."""
        load, borne = of.load.field[e], of.borne.field[e] + part
        if now.first != 0:
            if now.fresh != 0 and now.span.since == 0:
                borne = part  # a start (velocities were set): forces were different before it
            if (now.span.since + now.s) % WINDOW == 0:
                load = self.learn(of, i, j, e, load, (borne - part) / (WINDOW * now.h * now.h))
                of.load.field[e] = load
                borne = part  # the next window begins with this substep
        if not bears:
            load *= 0
            of.load.field[e] = load
        of.borne.field[e] = borne
        return load

    @ti.func
    def share(self, own, k):
        """Return the share that is learnt of a load of k [m/s^2], of particles accelerated by their own weight `own` [m/s^2]."""
        return learnt_share(own * own, ti.static(SLOW_BODIES) * k * k + ti.static(LAG_BODIES) * own * own, WINDOW)

    @ti.func
    def learn(self, of: ti.template(), i, j, e, load, mean):  # type: ignore[valid-type]
        """Return one load of entry e after a window in which `mean` of it was missing on average [N]."""
        if is_steady(mean, of.earlier.field[e]) and self.motion.is_steady(i) and self.motion.is_steady(j):
            k = ti.abs(load + mean) * ti.max(self.state.w.of(i), self.state.w.of(j))
            own = ti.max(self.weights.field[i], self.weights.field[j])
            share = self.share(own, k)
            load, mean = load + share * mean, (1 - share) * mean
            if ti.static(of.pushes):
                load = ti.max(load, 0)
        of.earlier.field[e] = mean
        return load
