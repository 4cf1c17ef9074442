"""Links that pull and do not push."""

from ..checks import ArrayLike
from .core.length import REST_LENGTH, Length
from .core.scalar import Scalar


class Rope(Scalar):
    """Links that are at most as long as given: a taut rope acts as a Distance, a slack rope exerts no force.

    C(x) = |x_i - x_j| - length <= 0, gradients as in Distance; the multiplier may only pull.

    pairs: (m, 2) particle indices.
    length: number or (m,) [m]; None takes the initial distances. Assign to .rest to change it.
    compliance, damping: number or (m,) [m/N] and [N s/m], of the taut rope. A rigid rope that becomes taut takes the impact
    inelastically.
    break_at: tension at which a rope breaks, number or (m,) [N].
    """

    side = 1
    measures = Length
    rest = REST_LENGTH
    rest_name = "length"

    def __init__(self, pairs, length=None, *, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0, break_at=None):
        self.setup(pairs, length, compliance, damping, break_at)
