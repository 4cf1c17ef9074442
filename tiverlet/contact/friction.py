"""Coulomb friction of contacts, whatever their geometry."""

from ..device import ti
from ..features.material import Table, limited


class Friction:
    """Slip is taken back up to friction times the overlap (Cundall and Strack 1979). table: has the coefficients of pairs."""

    def __init__(self, table: Table):
        self.table = table

    @ti.func
    def held(self, i, j, n, normal, slip):
        """The part of a slip [m] of particles i and j that friction takes back, for a normal displacement along n [m]."""
        s, row = slip - slip.dot(n) * n, self.table.of(i, j)
        return limited(s, row[0] * normal, row[1] * normal)
