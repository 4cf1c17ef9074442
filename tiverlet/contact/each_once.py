"""Each pair solved once: its push is computed for one of its particles, and the opposite push is added to the other one."""

from typing import TYPE_CHECKING, Any

from ..device import inline, record, ti

if TYPE_CHECKING:
    from ..neighbours.neighbour_list import NeighbourList
    from .mass_splitting import MassSplitting

ROUNDS = 2  # in which a thread solves the pairs of its particles, see EachOnce


@record
class Turn:
    """Which pairs are solved now: those of particles begin ... end - 1, which one thread solves in turn, in this round."""

    def __init__(self, begin, end, round):
        self.begin, self.end, self.round = begin, end, round


class EachOnce:
    """The order in which pairs are solved once instead of once for each particle.

    A thread solves the pairs of its particles begin ... end - 1 in the order of these. For a pair of two of them, the particle
    with the lower index computes the push and adds the opposite one to the other particle. A pair with a particle of another
    piece is solved by both particles, each for itself. Both ways give the same bits:

    - A push and the opposite one differ in their sign only, since all differences of the two particles do.
    - The pushes of a particle are added up in the order of its partners' indices, as they are listed. So the first round solves
      pairs with particles below `begin`. In the second round a particle has got the pushes of all lower partners before its own
      turn.

    unsolved: bits of the first 32 entries of a particle, for pairs that its partners have not solved. Both particles of a pair
    find that they touch by the same numbers, so the lowest bit belongs to the lowest partner that has not had its turn. Pairs at
    later entries of the upper particle are solved by both.
    """

    def __init__(self, pairs: "NeighbourList", splitting: "MassSplitting"):
        self.list, self.splitting = pairs, splitting
        self.unsolved: Any = pairs.old_number  # free except while a list is built, and set anew in each pass

    @ti.func
    def begin(self, i):
        """Begin a pass of particle i."""
        self.unsolved[i] = ti.cast(self.list.touching[i], ti.i32)

    @ti.func
    def bits(self, i, word, turn):
        """Return the bits of the pairs at this word of the list of particle i that are solved in this round."""
        out = ti.cast(self.unsolved[i], ti.u32)
        if word > 0:
            out = self.splitting.touches(i, word)
        elif turn.round == 0:
            left = out
            while left != 0 and self.list.neighbour[self.list.entry(i, 0, left)] < turn.begin:
                left &= left - ti.u32(1)
            self.unsolved[i] = ti.cast(left, ti.i32)
            out ^= left
        return out

    @ti.func
    def word_count(self, i, turn):
        """Return the number of words of bits of particle i in this round."""
        return ti.select(turn.round == 0, 1, self.list.word_count(i))

    @ti.func
    def take_over(self, i, j, turn):
        """Return the entry of particle i in the list of j if i solves this pair for j, too, else -1."""
        out = -1
        if j > i and j < turn.end:
            bits = ti.cast(self.unsolved[j], ti.u32)
            if bits != 0:
                out = self.list.entry(j, 0, bits)
                self.unsolved[j] = ti.cast(bits & (bits - ti.u32(1)), ti.i32)
        return out


@inline
def first_round(contact, begin):
    """Return the first round for particles from `begin` on: the first of the two has nothing to do where these are the first."""
    return ti.cast(begin == 0, ti.i32) if contact.once else ROUNDS - 1
