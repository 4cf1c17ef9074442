"""Piles that carry their loads: what contacts bear at rest, they give without being asked."""

from typing import TYPE_CHECKING

import numpy as np

from ..device import ti
from ..features.feature import Acceleration
from ..features.learning import gain, steady
from ..neighbours.neighbour_list import PairData
from ..neighbours.queries import between

if TYPE_CHECKING:
    from ..features.feature import Scene
    from ..neighbours.neighbour_list import NeighbourList

WINDOW = 128  # substeps over which is averaged what is missing; at their end sound has just been taken out
SLOW = 0.3  # substeps that it takes to learn the load of k particles, per k^2
SAME = 1e-3  # of its length: by how much the line between a pair may change where particles are put elsewhere


class Carried(Acceleration):
    """What particles are given of the loads that their contacts know [m/s^2], as one more force. field: it, (n, dim)."""

    uniform = True  # it has no stiffness: it changes by what is learnt

    def __init__(self, scene: "Scene"):
        self.field = scene.memory.field("Contact.carried", scene.count, width=scene.particles.dim, state=True)

    @ti.func
    def acceleration(self, i, x, v, t):
        """Of particle i."""
        return self.field[i]


class KnownLoads:
    """Each pair knows the load F [N] that it bears, and gives it in every substep like a force, before positions are looked at.
    Contacts add what is missing, and may take back what was given, but never pull. It acts along the normal that the pair has as
    the last substep ends: the next one starts there, so it has no moment.

    One pass per substep holds a load by an overlap, 2 k g h^2 for the k-th contact of a column; what is known needs none. F is
    learnt by and by, which is integral control: over a window, contacts added `mean`, and if that is what they added in the
    window before to within a fifth, F += gain mean. A substep sees a constant force, so it is as stable as without.
    What is learnt must not be faster than the slowest sound of the pile decays, see VelocityProjection: in a column of N in
    0.1 N^2 substeps. So gain = WINDOW / (LAG + SLOW k^2), with k = F / (m g) the number of particles that a pair bears. An
    impact has a large k, and is not learnt.

    A pair that gives nothing in the end, because its particles have parted or bounced, forgets at once. Restitution asks the
    overlap of a pair whether it rests; one that knows its load has that, too, which would hold it. A wall takes back in the same
    substep what is pushed into it; for contacts to know, particles are where walls leave them while contacts are solved (`lean`),
    and walls begin again with all that is pushed into them, which friction needs.

    Warm starting (Box2D) of a single pass would be unstable: a mode of eigenvalue L has z^3 - 3 a z^2 + 3 a z - a, a = 1 - r L,
    whose roots near 1 grow like (r L)^(1/3) / 2.
    """

    def __init__(self, scene: "Scene"):
        self.state, self.weights = scene.state, scene.own_weight
        self.load = PairData("load", 0, lasting=True, marked=True)  # [N]
        self.borne = PairData("borne", 0, lasting=True, marked=True)  # what was missing of it in this window, summed up [kg m]
        self.earlier = PairData("earlier", 0, lasting=True, marked=True)  # on average in the window before [N]
        self.pair_data = [self.load, self.borne, self.earlier]
        n, dim = scene.count, scene.particles.dim
        self.carried = Carried(scene)
        self.lean = scene.memory.field("Contact.lean", n, width=dim)  # how far walls moved it before contacts were solved [m]
        self.in_state = {"carried": self.carried.field}

    def bind(self, pairs: "NeighbourList") -> None:
        """pairs: those that are listed."""
        self.list = pairs

    def forget(self, scene: "Scene", x: np.ndarray) -> None:
        """Before particles are put to x, (n, dim): pairs that are others there forget."""
        pairs, values = self.list.lasting_data()
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
        """Give particles at x, (n, dim), what pairs (m, 2) know, of values as in NeighbourList.lasting_data()."""
        i, j = pairs.T
        r = between(x[i], x[j], scene.periodic)
        length = np.linalg.norm(r, axis=1)
        force = r * np.divide(values["load"], length, out=np.zeros_like(length), where=length > 0)[:, None]
        sums = [np.bincount(i, column, minlength=len(x)) for column in force.T]
        scene.memory.write(self.carried.field, scene.inv_mass[:, None] * np.stack(sums, axis=1))

    @ti.func
    def given(self, e, now):
        """What entry e was given in this substep, per inverse mass [kg m]."""
        return self.load.field[e] * self.weights.integrator.h2_effective(now.h, now.fresh)

    @ti.func
    def remember(self, i, j, e, part, push, now):
        """Entry e, the pair of i and j, got `part` in this pass, and `push` in all. Returns what it gives from now on [N]."""
        load, borne = self.load.field[e], self.borne.field[e] + part
        if now.first != 0:
            if now.fresh != 0:
                borne = part  # a start: forces were others before it
            if (now.span.since + now.s) % WINDOW == 0:
                load = self.learn(i, j, e, load, (borne - part) / (WINDOW * now.h * now.h))
                self.load.field[e] = load
                borne = part  # a start: forces were others before it
        if push <= 0:
            load *= 0
            self.load.field[e] = load
        self.borne.field[e] = borne
        return load

    @ti.func
    def learn(self, i, j, e, load, mean):
        """At the end of a window, in which entry e lacked `mean` of its load: what it knows from now on [N]."""
        if steady(mean, self.earlier.field[e]):
            k = ti.abs(load + mean) * ti.max(self.state.w.of(i), self.state.w.of(j))
            own = ti.max(self.weights.field[i], self.weights.field[j])
            share = gain(own * own, SLOW * k * k, WINDOW)
            load, mean = ti.max(load + share * mean, 0), (1 - share) * mean
        self.earlier.field[e] = mean
        return load
