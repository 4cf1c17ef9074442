"""Links: of given length, and those that only pull or only push."""

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
