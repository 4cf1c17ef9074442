"""The solver of a world whose user names none."""

from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np

from ..constraints.core.corner_passes import LOST
from ..geometry.ordered import distinct
from .conjugate import ConjugateGradient
from .corners import components, corners_of
from .direct import Direct
from .elimination import plan
from .jacobi import Jacobi
from .solver import Solver
from .system import solvable

if TYPE_CHECKING:
    from ..constraints.core.scalar import Scalar
    from ..features.feature import Batch, Scene

USUAL = 1 / 1200  # [s] substep: 20 of a frame of 1/60 s
MANY = 200  # stiff constraints from which conjugate gradients are worth their sums
BODY = 25  # of them in one piece, from which they count: in a pile of braced boxes Jacobi leaves 6e-3, the least at equal time
STEPS = 5  # of conjugate gradients: at equal time 5 to 20 leave about the same, and these take the least of a frame
CHAIN = 2  # width of chains, trees, loops, joints of up to 3 rods
BEAM = 5  # width of trusses, triangles on hinges, chains that bend: elimination takes two to three times what Jacobi does
RING = 8  # width of rings that bend: at 20 substeps Jacobi loses 0.5 to 60 % of their energy in 20 s, elimination 0 to 7 %
LONG = 2000  # constraints of a piece up to which it is tried as a beam: to refuse a net of more would take long


def by_structure(batches: "list[Batch]", scene: "Scene") -> Solver:
    """The solver of a world whose user names none: the one that leaves few stiff constraints to Jacobi.

    ConjugateGradient where elimination would leave MANY or more, in pieces of BODY or more that hang together, such as cloth: at
    equal time it leaves two thirds of what Jacobi and Chebyshev do, with as many substeps an eighth. Else Direct where pieces are
    chains, trees, loops or beams: it leaves some 1e-4 of the length of a link, Jacobi a tenth. Else Jacobi, for few or soft links
    and for pieces that start with violated constraints, which may contradict each other: relaxed, they settle on a compromise.
    """
    links = solvable(batches)
    if not links:
        return Jacobi()
    pieces = Pieces(links, scene)
    direct, taken = pieces.direct()
    if pieces.many(~taken) and all(_converges(b, scene) for b in links):
        return ConjugateGradient(STEPS)
    return direct or Jacobi()


def reason(solver: Solver) -> str:
    """Why by_structure() has chosen this one."""
    if isinstance(solver, Direct):
        return f"links hang together like chains, trees, loops or beams, but for fewer than {MANY} stiff ones"
    if isinstance(solver, ConjugateGradient):
        return f"links are stiff, at least {MANY}, and hang together more closely than elimination takes"
    return "links are few, soft or violated at the start, or there are angles that elimination is not for, or none"


def _eliminates(b: "Scalar", scene: "Scene") -> bool:
    """Whether elimination is trusted with scenes that have these: with links, and of angles with springs between links in 2D, and
    with motors there whose torque is limited, which are relaxed.

    It pumps with limits of angles; in 3D, where a straight path has no plane in which to turn; and with rigid angles, for which
    it takes one step of Newton's method: a chain of 20 links that whips gains 0.2 of m g times its length in a minute.
    """
    soft = b.relaxed_alone(scene) if b.driven else b.compliance > 0
    return b.arity <= 2 or bool(b.quantity.curved and b.arity == 3 and scene.particles.dim == 2 and not b.side and soft.all())


def _converges(b: "Scalar", scene: "Scene") -> bool:
    """Whether conjugate gradients are trusted with scenes that have these: not with rigid angles of paths in 3D, nor with rigid
    constraints of the user's own on more than two particles. Limits of angles are relaxed beside them."""
    known = b.quantity.curved and (b.arity == 4 or scene.particles.dim == 2)
    return b.arity <= 2 or bool(b.side) or known or not ((b.compliance == 0) & ~b.relaxed_alone(scene)).any()


class Pieces:
    """What hangs together by particles that can move, of constraints that systems could take."""

    def __init__(self, links: "list[Scalar]", scene: "Scene"):
        w, counts = scene.inv_mass, [b.count for b in links]
        owner, item = corners_of(links)
        free = w[item] > 0
        self.dim, self.count, self.owner, self.item = scene.particles.dim, sum(counts), owner[free], item[free]
        self.piece = components(self.count, self.owner, self.item)
        self.acts = np.bincount(self.owner, minlength=self.count) > 0
        self.pair = np.concatenate([np.zeros((0, 2), dtype=np.int64), *(b.indices for b in links if b.arity == 2)])
        self.pair_of = np.flatnonzero(np.repeat([b.arity == 2 for b in links], counts))
        self.bends = self._any(np.repeat([b.arity > 2 for b in links], counts))
        off = np.concatenate([_off(b) for b in links])
        self.exact = not off.any() and all(_eliminates(b, scene) for b in links)
        degree = np.bincount(np.concatenate([b.indices.ravel() for b in links]), minlength=len(w))
        self.solved = self.acts & ~np.concatenate([b.relaxed_alone(scene) for b in links])
        stiff = np.concatenate([_stiff(b, degree * w) for b in links]) & self.solved
        self.firm = stiff | ~self.solved | np.repeat([b.arity == 2 for b in links], counts)
        self.stiff = stiff & ~self._any(off)
        self.stands = self._stands(owner[~free], item[~free])

    def _any(self, some: np.ndarray) -> np.ndarray:
        """Of each constraint: whether its piece has any of these."""
        return np.bincount(self.piece, weights=some & self.acts, minlength=self.count)[self.piece] > 0

    def _stands(self, owner: np.ndarray, item: np.ndarray) -> np.ndarray:
        """Of each constraint: whether its piece is held in one place at most, and has no more constraints than freedoms, but for
        the springs of angles, which bear whatever they are loaded with. What does not stand may be loaded as no constraint bears
        to first order (a beam between two walls, a braced box between contacts).

        (owner, item): corners that cannot move; those that constraints join are one place. A piece of n particles that can move
        has dim n freedoms, less the motions of the whole.
        """
        place = components(self.count, owner, item)
        pins, places = self._number(owner, item), self._number(owner, place[owner])
        whole = np.array([3, 1, 0] if self.dim == 2 else [6, 3, 1, 0])  # motions of the whole that so many pins leave
        n = self._number(self.owner, self.item)
        freedoms = np.where(n + pins > 2, self.dim * n - whole[np.minimum(pins, len(whole) - 1)], 1)
        rows = np.bincount(self.piece[self.acts & self.firm], minlength=self.count)
        return ((places <= 1) & (rows <= freedoms))[self.piece]

    def _number(self, owner: np.ndarray, what: np.ndarray) -> np.ndarray:
        """How many different ones each piece has, (m,), of `what` its constraints have."""
        each = distinct(np.stack([self.piece[owner], what], axis=1))[0]
        return np.bincount(each[:, 0], minlength=self.count)

    def _open(self, some: np.ndarray) -> np.ndarray:
        """How many loops of links in each of these pieces are not made of triangles: E links between V particles have E - V + 1
        loops. A net held by a corner has many, and gains energy from elimination as it whips, up to 0.15 of m g times its length;
        a ring has one."""
        near: dict[tuple[int, int], set[int]] = defaultdict(set)
        inside = np.isin(self.piece[self.pair_of], some) & self.acts[self.pair_of]
        piece, pair = self.piece[self.pair_of[inside]], np.sort(self.pair[inside], axis=1)
        edges = distinct(np.column_stack([piece, pair]))[0]
        for k, i, j in edges.tolist():
            near[k, i].add(j)
            near[k, j].add(i)
        triangles = np.array([len(near[k, i] & near[k, j]) for k, i, j in edges.tolist()], dtype=float) / 3
        particles = np.bincount([k for k, _ in near], minlength=self.count)
        return np.rint(np.bincount(edges[:, 0], 1 - triangles, self.count) - particles + 1).astype(int)[some]

    def direct(self) -> tuple[Direct | None, np.ndarray]:
        """Elimination as wide as it is trusted with all that it takes, None where it is not, or would take single links only; and
        which constraints it takes, (m,). What is wider than CHAIN, or has angles, has to stand, and be made of triangles, or of
        one loop with springs of angles."""
        taken = np.zeros(self.count, dtype=bool)
        longest = np.bincount(self.piece[self.acts], minlength=1).max()
        for width in ((CHAIN,) if longest > LONG else (RING, BEAM, CHAIN)) if self.exact else ():
            found = plan(self.count, self.owner, self.item, width)
            first = found.rows[found.part_begin[:-1]]
            widths = np.array(found.widths, dtype=int)
            wide = widths > CHAIN
            if width > CHAIN and not self._any(self.stiff)[first[wide]].any():
                continue
            if not self.stands[first[wide | self.bends[first]]].all():
                continue
            loops, ring = self._open(self.piece[first[wide]]), self.bends[first[wide]]
            if np.where(widths[wide] > BEAM, ring & (loops == 1), loops <= ring).all():
                taken[found.rows] = True
                crowd = np.bincount(self.item[(taken & self.solved)[self.owner]], minlength=1)
                return (Direct(max([CHAIN, *found.widths])) if crowd.max() > 1 else None), taken
        return None, taken

    def many(self, some: np.ndarray) -> bool:
        """Whether MANY or more of these constraints are stiff, act both ways, and are in pieces of BODY such ones or more."""
        sizes = np.bincount(self.piece[some & self.stiff], minlength=1)
        return sizes[sizes >= BODY].sum() >= MANY


def _stiff(b: "Scalar", split: np.ndarray) -> np.ndarray:
    """Which act both ways and are rigid, or links that are stiffer than what one pass of a usual substep makes of them,
    alpha < W h^2. split: of W."""
    if b.side or b.arity != 2:
        return (b.compliance == 0) & (not b.side)
    return b.compliance < split[b.indices].sum(axis=1) * USUAL**2


def _off(b: "Scalar") -> np.ndarray:
    """Which are violated at the start, by more than what directions there bear."""
    C = b.violation(b.start.position)
    return np.where(b.side, np.maximum(b.side * C, 0), np.abs(C)) * b.inverse_size(b.start.position) > LOST
