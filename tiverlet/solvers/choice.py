"""The choice of the default solver."""

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
from .redundancy import RIGID_MOTIONS, implied_links
from .solver import Solver
from .system import solvable

if TYPE_CHECKING:
    from ..constraints.core.scalar import Scalar
    from ..features.feature import Batch, Scene

USUAL_SUBSTEP = 1 / 1200  # [s] substep: 20 of a frame of 1/60 s
MANY_STIFF = 200  # stiff constraints from which conjugate gradients are worth their sums
# Stiff constraints in a piece from which they count: in a pile of braced boxes Jacobi is best at equal time, 6e-3.
LARGE_PIECE = 25
CG_STEPS = 5  # of conjugate gradients: at equal time, residuals of 5 to 20 steps are about the same; 5 take the least of a frame
CHAIN = 2  # width of chains, trees, loops, joints of up to 3 rods
BEAM = 5  # width of trusses, triangles on hinges, chains that bend: elimination takes two to three times as long as Jacobi
RING = 8  # width of rings that bend: at 20 substeps Jacobi loses 0.5 to 60 % of their energy in 20 s, elimination 0 to 7 %
BODY = 12  # width of rigid bodies with more links than hold them, such as a cube with all 28, which has no angle that is free
MOST_TRIED = 2000  # constraints in a piece up to which it is tried as a beam: refusing a larger net would take long


def choose_solver(batches: "list[Batch]", scene: "Scene", answers: bool) -> Solver:
    """Return the default solver: the one that leaves few stiff constraints to Jacobi.

    This is ConjugateGradient if elimination would leave MANY_STIFF or more stiff constraints, in connected pieces of LARGE_PIECE
    or more, such as cloth. Its residual is two thirds of that of Jacobi and Chebyshev at equal time, and an eighth with as many
    substeps. Else it is Direct if pieces are chains, trees, loops or beams: its residual is some 1e-4 of the length of a link,
    that of Jacobi a tenth. Where links `answer` contacts, it is Direct for single links, too, unless they join clusters: they
    answer after each pass of contacts then. Else it is Jacobi, for few or soft links, and for pieces that start with violated
    constraints. These may contradict each other; relaxed, they settle on a compromise.
    """
    links = solvable(batches)
    if not links:
        return Jacobi()
    pieces = Pieces(links, scene, [b for b in batches if b.clusters])
    direct, taken = pieces.choose_direct(answers)
    if pieces.has_many_stiff(~taken) and all(_may_iterate(b, scene) for b in links):
        return ConjugateGradient(CG_STEPS)
    return direct or Jacobi()


def explain_choice(solver: Solver) -> str:
    """Return why choose_solver() has chosen this solver."""
    if isinstance(solver, Direct):
        return f"links hang together like chains, loops or beams, or touch something, but for fewer than {MANY_STIFF} stiff ones"
    if isinstance(solver, ConjugateGradient):
        return f"links are stiff, at least {MANY_STIFF}, and hang together more closely than elimination takes"
    return "links are few, soft or violated at the start, or there are angles that elimination is not for, or none"


def _may_eliminate(b: "Scalar", scene: "Scene") -> bool:
    """Whether the default may use elimination in scenes with these constraints.

    It may for links, and for angles in 2D that are springs or are relaxed alone, such as motors of limited torque. Elimination
    pumps energy in with limits of angles; with angles in 3D, where a straight path has no plane in which to turn; and with rigid
    angles, for which it takes one Newton step: a chain of 20 links that whips gains 0.2 of m g times its length in a minute.
    """
    soft = b.relaxed_alone(scene) if b.driven else b.compliance > 0
    return b.arity <= 2 or bool(b.quantity.curved and b.arity == 3 and scene.particles.dim == 2 and not b.side and soft.all())


def _may_iterate(b: "Scalar", scene: "Scene") -> bool:
    """Whether the default may use conjugate gradients in scenes with these constraints.

    It may not with rigid angles of paths in 3D, nor with the user's own rigid constraints on more than two particles. Limits of
    angles are relaxed beside them.
    """
    known = b.quantity.curved and (b.arity == 4 or scene.particles.dim == 2)
    return b.arity <= 2 or bool(b.side) or known or not ((b.compliance == 0) & ~b.relaxed_alone(scene)).any()


class Pieces:
    """Connected pieces: sets of constraints that share movable particles, among those that a System could solve."""

    def __init__(self, links: "list[Scalar]", scene: "Scene", clusters: "list[Batch]"):
        w, counts = scene.inv_mass, [b.count for b in links]
        owner, item = corners_of(links)
        free = w[item] > 0
        self.dim, self.count, self.owner, self.item = scene.particles.dim, sum(counts), owner[free], item[free]
        self.piece = components(self.count, self.owner, self.item)
        self.acts = np.bincount(self.owner, minlength=self.count) > 0
        held = np.isin(self.item, np.concatenate([np.zeros(0, dtype=np.int64), *(b.indices.ravel() for b in clusters)]))
        twice = self._any(np.bincount(self.owner, held, self.count) > 0)  # pieces of particles that clusters hold, too
        self.implied, self.shares = implied_links(links, scene) & ~twice, bool(twice.any())
        self.pair = np.concatenate([np.zeros((0, 2), dtype=np.int64), *(b.indices for b in links if b.arity == 2)])
        self.pair_of = np.flatnonzero(np.repeat([b.arity == 2 for b in links], counts))
        self.has_angles = self._any(np.repeat([b.arity > 2 for b in links], counts))
        off = np.concatenate([_is_violated(b) for b in links])
        self.may_eliminate, self.is_off = all(_may_eliminate(b, scene) for b in links), bool(off.any())
        degree = np.bincount(np.concatenate([b.indices.ravel() for b in links]), minlength=len(w))
        self.solved = self.acts & ~np.concatenate([b.relaxed_alone(scene) for b in links])
        stiff = np.concatenate([_stiff(b, degree * w) for b in links]) & self.solved
        self.is_counted = stiff | ~self.solved | np.repeat([b.arity == 2 for b in links], counts)
        self.stiff = stiff & ~self._any(off)
        self.is_determinate, self.is_body = self._is_determinate(owner[~free], item[~free])

    def _any(self, some: np.ndarray) -> np.ndarray:
        """Return for each constraint, (m,), whether its piece has any constraint in the mask `some`, (m,)."""
        return np.bincount(self.piece, weights=some & self.acts, minlength=self.count)[self.piece] > 0

    def _is_determinate(self, owner: np.ndarray, item: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return for each constraint, (m,), whether its piece is held in one place at most and is not overconstrained.

        And whether the piece is a rigid body with links that others imply, which may be held anywhere.

        Springs of angles do not count as constraints here, because they bear any load, nor do links that others imply, because
        they bear none. Any other piece may bear loads that no constraint bears to first order, such as a rope between two walls.
        (owner, item): corners that cannot move; corners that constraints join are one place. A piece of n movable particles has
        dim n degrees of freedom, minus the rigid motions of the piece.
        """
        place = components(self.count, owner, item)
        pins, places = self._count_distinct(owner, item), self._count_distinct(owner, place[owner])
        whole = np.array(RIGID_MOTIONS[self.dim])
        n = self._count_distinct(self.owner, self.item)
        freedoms = np.where(n + pins > 2, self.dim * n - whole[np.minimum(pins, len(whole) - 1)], 1)
        rows = np.bincount(self.piece[self.acts & self.is_counted & ~self.implied], minlength=self.count)
        body = (rows == freedoms)[self.piece] & self._any(self.implied)
        return ((places <= 1) & (rows <= freedoms))[self.piece] | body, body

    def _count_distinct(self, owner: np.ndarray, what: np.ndarray) -> np.ndarray:
        """Return how many distinct values of `what` the constraints `owner` of each piece have, (m,)."""
        each = distinct(np.stack([self.piece[owner], what], axis=1))[0]
        return np.bincount(each[:, 0], minlength=self.count)

    def _count_open_loops(self, some: np.ndarray) -> np.ndarray:
        """Return how many loops of links in each of the pieces `some` are not made of triangles.

        E links between V particles have E - V + 1 loops. A net held by a corner has many, and gains energy from elimination when
        it whips, up to 0.15 of m g times its length. A ring has one.
        """
        near: dict[tuple[int, int], set[int]] = defaultdict(set)
        inside = np.isin(self.piece[self.pair_of], some) & (self.acts & ~self.implied)[self.pair_of]
        piece, pair = self.piece[self.pair_of[inside]], np.sort(self.pair[inside], axis=1)
        edges = distinct(np.column_stack([piece, pair]))[0]
        for k, i, j in edges.tolist():
            near[k, i].add(j)
            near[k, j].add(i)
        triangles = np.array([len(near[k, i] & near[k, j]) for k, i, j in edges.tolist()], dtype=float) / 3
        particles = np.bincount([k for k, _ in near], minlength=self.count)
        return np.rint(np.bincount(edges[:, 0], 1 - triangles, self.count) - particles + 1).astype(int)[some]

    def choose_direct(self, answers: bool) -> tuple[Direct | None, np.ndarray]:
        """Return Direct with the largest width that is trusted, or None; and a mask of the constraints that it takes, (m,).

        It is None where no width is trusted, or only single links would be taken, unless they answer contacts. Pieces that are
        wider than CHAIN or have angles must satisfy _is_determinate(), and consist of triangles or of one loop with springs of
        angles.
        """
        taken = np.zeros(self.count, dtype=bool)
        if np.bincount(self.item[self.solved[self.owner]], minlength=1).max() <= 1:  # which cannot contradict each other
            return Direct(CHAIN) if answers and self.may_eliminate and not self.shares else None, self.solved
        if self.is_off or not self.may_eliminate:
            return None, taken
        longest, needed = np.bincount(self.piece[self.acts], minlength=1).max(), ~self.implied[self.owner]
        for width in (CHAIN,) if longest > MOST_TRIED else (BODY, RING, BEAM, CHAIN):
            found = plan(self.count, self.owner[needed], self.item[needed], width)
            first = found.rows[found.part_begin[:-1]]
            widths = np.array(found.widths, dtype=int)
            wide = widths > CHAIN
            if width > CHAIN and not self._any(self.stiff)[first[wide]].any():
                continue
            if not self.is_determinate[first[wide | self.has_angles[first]]].all():
                continue
            loops, ring = self._count_open_loops(self.piece[first[wide]]), self.has_angles[first[wide]]
            fine = (widths[wide] <= RING) & np.where(widths[wide] > BEAM, ring & (loops == 1), loops <= ring)
            if (fine | self.is_body[first[wide]]).all():
                taken[found.rows] = True
                taken |= self.implied & self._any(taken)
                crowd = np.bincount(self.item[(taken & self.solved)[self.owner]], minlength=1)
                return (Direct(max([CHAIN, *found.widths])) if crowd.max() > 1 else None), taken
        return None, taken

    def has_many_stiff(self, some: np.ndarray) -> bool:
        """Whether MANY_STIFF or more in the mask `some` are stiff, two-sided, and in pieces with LARGE_PIECE or more of these."""
        sizes = np.bincount(self.piece[some & self.stiff], minlength=1)
        return sizes[sizes >= LARGE_PIECE].sum() >= MANY_STIFF


def _stiff(b: "Scalar", split: np.ndarray) -> np.ndarray:
    """Return which constraints are two-sided and stiff, (m,): rigid ones, and links with a compliance alpha < W h^2.

    Below that, one Jacobi pass of a usual substep is softer than the link itself. split: (n,) mass-split weights, for W.
    """
    if b.side or b.arity != 2:
        return (b.compliance == 0) & (not b.side)
    return b.compliance < split[b.indices].sum(axis=1) * USUAL_SUBSTEP**2


def _is_violated(b: "Scalar") -> np.ndarray:
    """Return which constraints are violated at the start by more than LOST of their size, (m,)."""
    C = b.violation(b.start.position)
    return np.where(b.side, np.maximum(b.side * C, 0), np.abs(C)) * b.inverse_size(b.start.position) > LOST
