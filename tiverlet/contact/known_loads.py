"""Known loads: each pair learns the load that it bears at rest, and applies it in every substep like a force."""

from typing import TYPE_CHECKING

import numpy as np

from ..device import ti
from ..features.feature import Acceleration
from ..features.learning import is_steady, learnt_share
from ..neighbours.neighbour_list import PairData
from ..neighbours.queries import between

if TYPE_CHECKING:
    from ..features.feature import Scene
    from ..neighbours.neighbour_list import NeighbourList

WINDOW = 128  # substeps over which the missing load is averaged; it begins just after sound is removed (EVERY)
SLOW = 0.3  # substeps that it takes to learn the load of k particles, per k^2
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


class KnownLoads:
    """The known loads of contacts: each pair stores the load F [N] that it bears, and applies it in every substep like a force.

    The force acts before contacts are detected. Contacts add the missing part. They may take back a part of F, but never pull. F
    acts along the normal of the pair at the end of the last substep, where the next one starts, so it has no moment.

    One pass per substep holds a load by an overlap, 2 k g h^2 for the k-th contact of a column. A known load needs no overlap. F
    is learnt gradually, which is integral control. If contacts added `mean` on average over a window, within a fifth of what they
    added in the window before, F += gain mean. Within a substep F is constant, so stability is the same as without.

    Learning must be slower than the slowest sound of the pile decays, see VelocityProjection: 0.1 N^2 substeps in a column of N.
    So gain = WINDOW / (LAG + SLOW k^2), with k = F / (m g) the number of particles that a pair bears. An impact has a large k, so
    it is not learnt.

    A pair with no push at the end of a pass, because its particles parted or bounced, forgets its load at once. Restitution
    decides by the overlap of a pair whether it rests; for a known load, the overlap that would hold it is added.

    A wall undoes, in the same substep, the displacement into it. For contacts to see that, particles are placed where walls leave
    them while contacts are solved (`wall_move`). Walls then start again with the whole displacement into them, which friction
    needs.

    Warm starting (Box2D) of a single pass would be unstable: a mode of eigenvalue L has the characteristic polynomial
    z^3 - 3 a z^2 + 3 a z - a, a = 1 - r L, whose roots near 1 grow like (r L)^(1/3) / 2.
    """

    def __init__(self, scene: "Scene"):
        self.state, self.weights = scene.state, scene.own_weight
        self.load = PairData("load", 0, persistent=True, only_touching=True)  # [N]
        self.borne = PairData("borne", 0, persistent=True, only_touching=True)  # sum of the missing part in this window [kg m]
        self.earlier = PairData("earlier", 0, persistent=True, only_touching=True)  # mean missing part in the window before [N]
        self.pair_data = [self.load, self.borne, self.earlier]
        n, dim = scene.count, scene.particles.dim
        self.carried = Carried(scene)
        self.wall_move = scene.memory.field("Contact.lean", n, width=dim)  # by walls, before contacts were solved [m]
        self.in_state = {"carried": self.carried.field}

    def bind(self, pairs: "NeighbourList") -> None:
        """Store the neighbour list, which holds the pair data."""
        self.list = pairs

    def forget(self, scene: "Scene", x: np.ndarray) -> None:
        """Clear the loads of pairs whose relative position changes, before particles are moved to x (n, dim) [m]."""
        pairs, values = self.list.persistent_data()
        if not values["load"].any():
            return
        i, j = pairs.T
        old = scene.state.get(scene.memory)
        before = between(old[i], old[j], scene.periodic)
        moved = np.linalg.norm(between(x[i], x[j], scene.periodic) - before, axis=1) > SAME * np.linalg.norm(before, axis=1)
        for piece in self.pair_data:
            values[piece.name][moved] = 0.0
        self.list.restore(pairs, values)
        self.carry(scene, x, pairs, values)

    def carry(self, scene: "Scene", x: np.ndarray, pairs: np.ndarray, values: dict[str, np.ndarray]) -> None:
        """Set the accelerations of particles at x (n, dim) [m] by the loads of pairs (m, 2).

        values: as returned by NeighbourList.persistent_data().
        """
        i, j = pairs.T
        r = between(x[i], x[j], scene.periodic)
        length = np.linalg.norm(r, axis=1)
        force = r * np.divide(values["load"], length, out=np.zeros_like(length), where=length > 0)[:, None]
        sums = [np.bincount(i, column, minlength=len(x)) for column in force.T]
        scene.memory.write(self.carried.field, scene.inv_mass[:, None] * np.stack(sums, axis=1))

    @ti.func
    def known_push(self, e, now):
        """Return what the known load of entry e gave in this substep, per inverse mass [kg m]."""
        return self.load.field[e] * self.weights.integrator.h2_effective(now.h, now.fresh)

    @ti.func
    def update_load(self, i, j, e, part, push, now):
        """Update the load of entry e, the pair of i and j, and return it [N].

        part: the push that contacts added in this pass [kg m]. push: the whole push of the pair [kg m].
        """
        load, borne = self.load.field[e], self.borne.field[e] + part
        if now.first != 0:
            if now.fresh != 0 and now.span.since == 0:
                borne = part  # a start (velocities were set): forces were different before it
            if (now.span.since + now.s) % WINDOW == 0:
                load = self.learn(i, j, e, load, (borne - part) / (WINDOW * now.h * now.h))
                self.load.field[e] = load
                borne = part  # the next window begins with this substep
        if push <= 0:
            load *= 0
            self.load.field[e] = load
        self.borne.field[e] = borne
        return load

    @ti.func
    def push_back(self, j, e, other, load):
        """Let particle j bear the opposite of a load (a vector) [N]. e, other: the entries of the pair in both lists."""
        self.carried.field[j] = self.carried.field[j] - self.state.w.of(j) * load
        for piece in ti.static(self.pair_data):
            piece.field[other] = piece.field[e]

    @ti.func
    def learn(self, i, j, e, load, mean):
        """Return the load of entry e after a window in which `mean` of it was missing on average [N]."""
        if is_steady(mean, self.earlier.field[e]):
            k = ti.abs(load + mean) * ti.max(self.state.w.of(i), self.state.w.of(j))
            own = ti.max(self.weights.field[i], self.weights.field[j])
            share = learnt_share(own * own, SLOW * k * k, WINDOW)
            load, mean = ti.max(load + share * mean, 0), (1 - share) * mean
        self.earlier.field[e] = mean
        return load
