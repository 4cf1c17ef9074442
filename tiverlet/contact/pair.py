"""A pair of discs or spheres in a pass, and what a particle sums up over its pairs."""

from ..device import record


@record
class Pair:
    """A touching pair in a pass, solved by particle i. A pass makes its push p = r C / M + c p_last along n, see Contact.

    i, j: the particles. e: the entry of the neighbour list that stores the data of the pair. other: the entry of i in the list of
    j if i solves the pair for j, too, else -1. sign: -1 if e is that entry, because i cannot move and stores nothing, else 1.
    overlap: C [m]. n: the normal from j to i. reach: the distance along n where the push acts [m].
    last: p_last, the push of the last pass [kg m]. shared: M, by split masses. alone: w_i + w_j, by whole masses.
    stiffness: r / M [kg]. carry: c.
    """

    def __init__(self, i, j, e, other, sign, overlap, n, reach, last, shared, alone, stiffness, carry):
        self.i, self.j, self.e, self.other, self.sign = i, j, e, other, sign
        self.overlap, self.n, self.reach, self.last = overlap, n, reach, last
        self.shared, self.alone, self.stiffness, self.carry = shared, alone, stiffness, carry


@record
class PairSums:
    """What a particle sums up over its pairs in a pass.

    w: its inverse mass. split: m w, with the mass split m times; 0 without contact. again, carries: factors 1 or 0, faster than
    branches: whether pairs continue from their push in this substep, and whether they carry a part of that of the last one.
    move: its correction [m]. lift: the same of its position only [m]. rubbed: the part of `move` by friction of impacts [m].
    forced: the part of `move` by friction that counts as a force, see ForceShare [m].
    turned: the correction of its spin [m]. turned_by_force: the part that counts as a force [m].
    carried: its acceleration by known loads [m/s^2]. excess: how much it has to shrink, see DiscGeometry.excess() [m].
    impacts: the number of its impacts that BodyRestitution solves.
    """

    def __init__(self, w, split, again, carries, move, lift, rubbed, forced, turned, turned_by_force, carried, excess, impacts):
        self.w, self.split, self.again, self.carries = w, split, again, carries
        self.move, self.lift, self.rubbed, self.forced = move, lift, rubbed, forced
        self.turned, self.turned_by_force = turned, turned_by_force
        self.carried, self.excess, self.impacts = carried, excess, impacts
