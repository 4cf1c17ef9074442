"""Linear drag."""

from .. import checks
from ..features.feature import Acceleration, Knob


class Drag(Acceleration):
    """Linear drag, a = -rate v. It is exact: in a time t without other forces, v falls by the factor exp(-rate t) for any step.

    rate: [1/s], at least 0. Live: assign to .rate between frames.

    With a constant acceleration a of other forces, the displacements obey d' = exp(-z) d + h^2 a (1 - exp(-z)) / z, z = rate h.
    """

    is_fixed_in_space = False
    has_no_particle_data = True
    accelerates = False
    decays = True
    rate = Knob(lambda f, v: checks.number("Drag", "rate", v, least=0.0), "Drag rate [1/s].")

    def __init__(self, rate):
        self.rate = rate
