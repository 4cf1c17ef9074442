"""Links that push and do not pull."""

from ..checks import ArrayLike
from .core.length import REST_LENGTH, Length
from .core.scalar import Scalar


class Spacer(Scalar):
    """Pairs of particles that stay at least `length` apart, whether or not the scene has contacts.

    C(x) = |x_i - x_j| - length >= 0, gradients as in Distance; the multiplier may only push.

    pairs: (m, 2) particle indices.
    length: number or (m,) [m]. Assign to .rest to change it.
    compliance, damping: number or (m,) [m/N] and [N s/m], of the pushing spring.
    break_at: load at which a spacer breaks, number or (m,) [N].
    """

    side = -1
    measures = Length
    rest = REST_LENGTH
    rest_name = "length"

    def __init__(self, pairs, length, *, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0, break_at=None):
        self.setup(pairs, length, compliance, damping, break_at)
