"""Links of given length."""

from ..checks import ArrayLike
from .core.length import REST_LENGTH, Length
from .core.scalar import Scalar


class Distance(Scalar):
    """Links: two particles stay a given distance apart.

    C(x) = |x_i - x_j| - rest,   grad_i C = (x_i - x_j) / |x_i - x_j| = -grad_j C.

    pairs: (m, 2) particle indices.
    rest: rest length, number or (m,) [m], at least 0; None takes the initial distances. Live.
    compliance: inverse stiffness, number or (m,) [m/N]; 0 is rigid. A spring of k [N/m] has compliance 1 / k.
    damping: of a dashpot parallel to the spring, number or (m,) [N s/m]; it has no effect on a rigid link.
    break_at: load at which a link breaks, pulled or pushed, number or (m,) [N]; None for never. A broken link does not act from
    the next substep on; see world.broken and .broken. Under a blow a link bears v sqrt(m k), if its period is resolved; a
    rigid one bears about m v / h, which grows with the number of substeps.

    Second order in h, without artificial damping, for every compliance (see tiverlet/step/README.md). `load` is the tension of
    each link [N].
    """

    measures = Length
    rest = REST_LENGTH

    def __init__(self, pairs, rest=None, *, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0, break_at=None):
        self.setup(pairs, rest, compliance, damping, break_at)
