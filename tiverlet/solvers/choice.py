"""The choice of the default solver."""

from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np

from .conjugate import MARGIN, POWER, ConjugateGradient
from .corners import components, corners_of
from .direct import Direct
from .elimination import plan
from .jacobi import Jacobi
from .joined import couples, joined_clusters
from .redundancy import implied_links
from .solver import WIDTH, Solver
from .spectrum import largest_eigenvalue
from .system import solvable

if TYPE_CHECKING:
    from ..constraints.core.scalar import Scalar
    from ..features.feature import Batch, Scene

USUAL_SUBSTEP = 1 / 1200  # [s] substep: 20 of a frame of 1/60 s
MANY_STIFF = 200  # stiff constraints from which conjugate gradients are worth their sums, whatever elimination would take
CG_STEPS = 5  # of conjugate gradients: at equal time, residuals of 5 to 20 steps are about the same; 5 take the least of a frame
ERROR = 0.025  # a bound on that of loads by conjugate gradients; of nets with a heavy particle it is 1 %, of even ones less
LEAST_STEPS, MOST_STEPS = 2, 20  # of conjugate gradients for soft links. More cost more of a frame than as many more substeps
SOFT = 25  # alpha / (W h^2) from which on a Jacobi pass bears loads to 1 %: a pass adds W h^2 / 4 to the compliance
# Products of an elimination that take as long as conjugate gradients: for each constraint, and for each system. A chain has 1 for
# each constraint, a ladder 6, a wheel of 12 spokes 36, nets of 8 x 8 and 9 x 9 60 and 75.
PRODUCTS, OVERHEAD = 50, 2000
CHAIN = 2  # width of chains, trees, loops, joints of up to 3 rods
MOST_TRIED = 2000  # constraints in a piece up to which it is tried as wider: refusing a larger net would take long


def choose_solver(batches: "list[Batch]", scene: "Scene", answers: bool) -> Solver:
    """Return the default solver: the one that leaves few stiff constraints to Jacobi.

    Direct solves what hangs together in systems up to its usual width: chains, trees, ladders, trusses, wheels, bodies. Its
    residual is some 1e-6 of the length of a link, that of Jacobi a hundredth, in one to four times the time. Single links, too,
    where they `answer` contacts or join rigid clusters, but not clusters that are no bodies of a system. ConjugateGradient solves
    what is wider or faster by it, such as cloth and nets, where that is more of the stiff constraints, or MANY_STIFF. Its
    residual is an eighth of that of Jacobi with as many substeps. Jacobi is left with links of SOFT, with each by itself, and
    with few inside of a cluster: these may contradict it; relaxed, they settle on a compromise.
    """
    links = solvable(batches)
    if not links:
        return Jacobi()
    pieces = Pieces(links, scene, batches, answers)
    direct, taken = pieces.choose_direct(answers)
    left, solved = pieces.count_stiff(~taken), pieces.count_stiff(taken)
    enough = MANY_STIFF if pieces.is_inside else min(MANY_STIFF, max(solved, 1))
    if left >= enough and all(_may_iterate(b, scene) for b in links):
        return ConjugateGradient(pieces.count_steps())
    return direct or Jacobi()


def explain_choice(solver: Solver) -> str:
    """Return why choose_solver() has chosen this solver."""
    if isinstance(solver, Direct):
        return "links hang together like chains, loops, beams or small nets, join bodies, or touch something"
    if isinstance(solver, ConjugateGradient):
        return "links are stiff, and hang together more closely than elimination takes, or by angles that it is not for"
    return "links are soft, each by itself, inside of a cluster or beside many that elimination takes, or there are none"


def _may_eliminate(b: "Scalar", scene: "Scene") -> bool:
    """Whether the default may use elimination in scenes with these constraints.

    It may for links, for limits of angles, and for angles in 2D that are springs or are relaxed alone, such as motors of limited
    torque. Elimination pumps energy in with springs of angles in 3D, where a straight path has no plane in which to turn, and
    with rigid angles, for which it takes one Newton step: a chain of 20 links that whips gains 0.2 of m g times its length in a
    minute.
    """
    soft = b.relaxed_alone(scene) if b.driven else b.compliance > 0
    bends = b.quantity.curved and b.arity == 3
    return b.arity <= 2 or bool(bends and (b.side or (scene.particles.dim == 2 and soft.all())))


def _may_iterate(b: "Scalar", scene: "Scene") -> bool:
    """Whether the default may use conjugate gradients in scenes with these constraints.

    It may not with rigid angles of paths in 3D, nor with the user's own rigid constraints on more than two particles. Limits of
    angles are relaxed beside them.
    """
    known = b.quantity.curved and (b.arity == 4 or scene.particles.dim == 2)
    return b.arity <= 2 or bool(b.side) or known or not ((b.compliance == 0) & ~b.relaxed_alone(scene)).any()


class Pieces:
    """Connected pieces: sets of constraints that share movable particles or bodies, among those that a System could solve."""

    def __init__(self, links: "list[Scalar]", scene: "Scene", batches: "list[Batch]", answers: bool):
        w = scene.inv_mass
        owner, item = corners_of(links)
        free = w[item] > 0
        alone = np.concatenate([b.relaxed_alone(scene, bounded=True) for b in links])
        body, clusters = joined_clusters(batches, alone, scene, answers), [b for b in batches if b.clusters]
        self.count, self.owner, self.item = sum(b.count for b in links), owner[free], couples(body, item[free])
        self.piece, self.joins = components(self.count, self.owner, self.item), bool((body >= 0).any())
        self.acts = np.bincount(self.owner, minlength=self.count) > 0
        held = np.isin(item[free], corners_of(clusters)[1]) & (body[item[free]] < 0)
        twice, inside = self._any(np.bincount(self.owner, held, self.count) > 0), self._inside(held, clusters)
        self.implied, self.shares = implied_links(links, scene) & ~twice, bool(twice.any())
        self.may_eliminate, self.is_inside = all(_may_eliminate(b, scene) for b in links), bool(inside.any())
        degree = np.bincount(item, minlength=len(w))
        self.links, self.scene = links, scene
        self.solved = self.acts & ~alone
        self.stiff = np.concatenate([_stiff(b, degree * w) for b in links]) & self.solved
        self.rigid = np.concatenate([b.compliance == 0 for b in links]) & self.solved

    def _any(self, some: np.ndarray) -> np.ndarray:
        """Return for each constraint, (m,), whether its piece has any constraint in the mask `some`, (m,)."""
        return np.bincount(self.piece, weights=some & self.acts, minlength=self.count)[self.piece] > 0

    def _inside(self, held: np.ndarray, clusters: "list[Batch]") -> np.ndarray:
        """Return which constraints have several corners, and all of them in one cluster, (m,). held: mask of corners in any."""
        holds, common = defaultdict(set), dict[int, set]()
        for cluster, i in zip(*(one.tolist() for one in corners_of(clusters)), strict=True):
            holds[i].add(cluster)
        for c, i in zip(self.owner.tolist(), self.item.tolist(), strict=True) if held.any() else ():
            common[c] = common.get(c, holds[i]) & holds[i]
        return np.array([bool(common.get(c)) for c in range(self.count)]) & (np.bincount(self.owner, minlength=self.count) > 1)

    def choose_direct(self, answers: bool) -> tuple[Direct | None, np.ndarray]:
        """Return Direct, or None where it would take nothing; and a mask of the constraints that it is best for, (m,).

        Systems wider than CHAIN are for stiff constraints and ropes. Single links are taken where they answer contacts.
        """
        taken = np.zeros(self.count, dtype=bool)
        crowd = np.bincount(self.item[self.solved[self.owner]], minlength=1)
        if crowd.max() <= 1 and not self.joins:  # which cannot contradict each other
            return Direct(CHAIN) if answers and self.may_eliminate and not self.shares else None, self.solved
        if self.is_inside or not self.may_eliminate:
            return None, taken
        longest, needed = np.bincount(self.piece[self.acts], minlength=1).max(), ~self.implied[self.owner]
        for width in (CHAIN,) if longest > MOST_TRIED else (WIDTH, CHAIN):
            found = plan(self.count, self.owner[needed], self.item[needed], width)
            wide = found.rows[found.part_begin[:-1]][np.array(found.widths, dtype=int) > CHAIN]  # a row of each wide system
            if width == CHAIN or self._any(self.stiff | self.rigid)[wide].any():
                break
        taken[found.rows] = True
        taken |= self.implied & self._any(taken)
        crowd = np.bincount(self.item[(taken & self.solved)[self.owner]], minlength=1)
        rows, products = np.diff(found.part_begin), np.diff(found.update_begin[found.part_begin])
        dear = np.repeat(products > PRODUCTS * rows + OVERHEAD, rows)
        taken &= ~self._any(np.isin(np.arange(self.count), found.rows[dear]))
        return (Direct(max([CHAIN, *found.widths])) if crowd.max() > 1 or self.joins else None), taken

    def count_stiff(self, some: np.ndarray) -> int:
        """Return how many in the mask `some` are stiff, two-sided, and in a piece with others: one by itself is solved anyway."""
        sizes = np.bincount(self.piece[some & self.stiff], minlength=1)
        return int(sizes[sizes > 1].sum())

    def count_steps(self) -> int:
        """Return the steps of conjugate gradients that find the loads of soft links to ERROR; CG_STEPS beside rigid links.

        The condition number is kappa = 1 + lambda_max A s, s = W h^2 / alpha, and the error 2 ((sqrt(kappa) - 1) / (sqrt(kappa)
        + 1))^steps. Links that take more than MOST_STEPS count as rigid ones.
        """
        w = self.scene.inv_mass
        s = np.concatenate([_stiffness(b, w) for b in self.links])
        s = s[self.solved & self.stiff & ~self.rigid]
        if not len(s):
            return CG_STEPS
        A = 1 - 0.75 / (1 + s**2)  # of the law, see Equation
        root = np.sqrt(1 + MARGIN * largest_eigenvalue(self.scene, self.links, w, POWER) * A * s)
        steps = np.ceil(np.log(2 / ERROR) / np.log((root + 1) / (root - 1)))
        least = CG_STEPS if (self.rigid & self.solved).any() or (steps > MOST_STEPS).any() else LEAST_STEPS
        return int(steps[steps <= MOST_STEPS].max(initial=least))


def _stiffness(b: "Scalar", w: np.ndarray) -> np.ndarray:
    """Return W h^2 / alpha of links in a usual substep, (m,), inf where rigid. w: (n,), inverse or mass-split weights, for W."""
    W = b.weights(b.start.position, w) * USUAL_SUBSTEP**2
    return np.divide(W, b.compliance, out=np.full(b.count, np.inf), where=b.compliance > 0)


def _stiff(b: "Scalar", split: np.ndarray) -> np.ndarray:
    """Return which constraints are two-sided and stiff, (m,): rigid ones, and links that a Jacobi pass would soften, see SOFT.

    split: (n,) mass-split weights.
    """
    if b.side or b.arity != 2:
        return (b.compliance == 0) & (not b.side)
    return b.compliance < SOFT * split[b.indices].sum(axis=1) * USUAL_SUBSTEP**2
