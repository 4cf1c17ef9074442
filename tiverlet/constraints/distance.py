"""Links of given length."""

import numpy as np
from numpy.typing import ArrayLike

from .. import checks
from ..device import ti
from ..features.feature import Knob
from .core.scalar import Scalar


class Link(Scalar):
    """What Distance, Rope and Spacer share: the distance of a pair, f(x) = |x_i - x_j|, and its gradients.

    Two particles in the same place have no direction between them; +x stands in for it.
    """

    arity = 2
    precise = True
    compiled_for = (*Scalar.compiled_for, "cusp")
    rest = Knob(lambda f, v: checks.per_item(repr(f), f.rest_name, v, f.count, least=0.0), "Rest length [m].")

    def rest_of(self, position: np.ndarray) -> np.ndarray:
        """Lengths of the links."""
        x = self.placed(position)
        return np.linalg.norm(x[:, 0] - x[:, 1], axis=1)

    @property
    def cusp(self) -> bool:
        """Whether any rest length is 0, or was when kernels were compiled."""
        return bool((self.goal == 0).any()) or vars(self.dev).get("cusp", False)

    def gradients(self, position: np.ndarray) -> np.ndarray:
        """As in measure()."""
        x = self.placed(position)
        r = x[:, 0] - x[:, 1]
        length = np.linalg.norm(r, axis=1, keepdims=True)
        n = np.divide(r, length, out=np.eye(1, r.shape[1]).repeat(len(r), axis=0), where=length > 0)
        return np.stack([n, -n], axis=1)

    @ti.func
    def excess(self, c, f, rest):
        """|r| - rest = (r^2 - rest^2) / (|r| + rest): to all digits of the low words, where there are any."""
        C = f - rest
        if ti.static(self.dev.state.carries):
            if f + rest > 0:
                r = self.dev.state.between(self.member(c, 0), self.member(c, 1))
                goal = ti.cast(rest, ti.f64)
                C = ti.cast(r.dot(r) - goal * goal, self.dev.real) / (f + rest)
        return C

    @ti.func
    def measure(self, c, q):
        """|r| and +- r / |r|, with r = x_0 - x_1."""
        r = q[0, :] - q[1, :]
        length = ti.sqrt(r.dot(r))
        n = 0 * r
        n[0] = 1
        if length > 0:
            n = r / length
        return length, ti.Matrix.rows([n, -n])

    @ti.func
    def exactly(self, c):
        """C in f64, which the difference of two lengths in f32 is not."""
        r = self.dev.state.between(self.member(c, 0), self.member(c, 1))
        return ti.sqrt(r.dot(r)) - ti.cast(self.dev.rest[c], ti.f64)  # type: ignore[reportOptionalCall]


class Distance(Link):
    """Links: two particles stay a given distance apart.

    C(x) = |x_i - x_j| - rest,   grad_i C = (x_i - x_j) / |x_i - x_j| = -grad_j C.

    pairs: (m, 2) particle indices.
    rest: rest length, number or (m,) [m], at least 0; None takes the initial distances. Live.
    compliance: inverse stiffness, number or (m,) [m/N]; 0 is rigid. A spring of k [N/m] has compliance 1 / k.
    damping: of a dashpot beside the spring, number or (m,) [N s/m]; beside a rigid link there is nothing for it to do.
    break_at: load beyond which a link breaks, pulled or pushed, number or (m,) [N]; None for never. It acts no more from the next
    substep on; see world.broken and .broken.

    Second order in h, without artificial damping, for every compliance (see Scalar). `load` is the tension of each link [N].
    """

    def __init__(self, pairs, rest=None, *, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0, break_at=None):
        self.setup(pairs, rest, compliance, damping, break_at)
