"""The solver of a world whose user names none."""

from typing import TYPE_CHECKING

import numpy as np

from ..constraints.core.corner_passes import LOST
from .conjugate import ConjugateGradient
from .direct import Direct
from .elimination import plan_of
from .jacobi import Jacobi
from .solver import Solver
from .system import solvable

if TYPE_CHECKING:
    from ..constraints.core.scalar import Scalar
    from ..features.feature import Batch

USUAL = 1 / 1200  # [s] substep: 20 of a frame of 1/60 s
MANY = 200  # stiff links from which systems are worth their sums
STEPS = 5  # of conjugate gradients: at equal time 5 to 20 leave about the same, and these take the least of a frame
WIDTH = 2  # of the systems that are solved directly where the user names no solver: chains, loops, joints of up to 3 rods


def by_structure(batches: "list[Batch]", inv_mass: np.ndarray) -> Solver:
    """The solver of a world whose user names none.

    Direct where links hang together like chains, trees or loops: for the cost of one relaxation it leaves some 1e-4 of the length
    of a link where Jacobi leaves a tenth. ConjugateGradient for what is denser, such as cloth, where many links are stiff: at
    equal time it leaves a third of what Jacobi and Chebyshev do. Jacobi for few or soft links; where there are rigid constraints
    on more than two particles, which contacts can lock in a shape that Newton's method does not leave; and for scenes that start
    with violated constraints, which may contradict each other: relaxed, they settle on a compromise.
    """
    links = solvable(batches)
    angles = [b for b in links if b.arity > 2]
    if not links or any((b.compliance == 0).any() for b in angles):
        return Jacobi()
    for b in links:
        C = b.violation(b.start.position)
        if (np.where(b.side, np.maximum(b.side * C, 0), np.abs(C)) * b.inverse_size(b.start.position) > LOST).any():
            return Jacobi()
    if not angles and len(plan_of(links, inv_mass, WIDTH).column):
        return Direct(WIDTH)
    return ConjugateGradient(STEPS) if stiff_links(links, inv_mass) >= MANY else Jacobi()


def stiff_links(links: "list[Scalar]", inv_mass: np.ndarray) -> int:
    """How many act both ways and are stiffer than what one pass of a usual substep makes of them, alpha < W h^2."""
    degree = np.bincount(np.concatenate([b.indices.ravel() for b in links]), minlength=len(inv_mass))
    return sum(
        int((b.compliance < (degree * inv_mass)[b.indices].sum(axis=1) * USUAL**2).sum())
        for b in links
        if b.arity == 2 and not b.side
    )


def reason(solver: Solver) -> str:
    """Why by_structure() has chosen this one."""
    if isinstance(solver, Direct):
        return "links hang together like chains, trees or loops"
    if isinstance(solver, ConjugateGradient):
        return f"links are stiff, at least {MANY}, and hang together more closely than elimination takes"
    return "links are few, soft or violated at the start, or there are rigid constraints on more than two particles, or none"
