"""Links that push and do not pull."""

from numpy.typing import ArrayLike

from .core.length import REST_LENGTH, Length
from .core.scalar import Scalar


class Spacer(Scalar):
    """Pairs that stay at least `length` apart, contact or not.

    C(x) = |x_i - x_j| - length >= 0, gradients as in Distance; the multiplier may only push.

    pairs: (m, 2); length: number or (m,) [m]; compliance [m/N] and damping [N s/m] of the pushing spring; break_at: load
    beyond which it breaks, number or (m,) [N].
    Assign to .rest to change the length.
    """

    side = -1
    measures = Length
    rest = REST_LENGTH
    rest_name = "length"

    def __init__(self, pairs, length, *, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0, break_at=None):
        self.setup(pairs, length, compliance, damping, break_at)
