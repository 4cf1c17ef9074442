"""The length of a link."""

from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from ...device import ti
from ...features.feature import Knob
from ...features.items import Items
from ...particles import LARGEST
from .quantity import Quantity, exact_rest

if TYPE_CHECKING:
    from .scalar import Scalar


def refuse_long(batch: Any, length: np.ndarray) -> None:
    """Raise ValueError for rest lengths [m] of half of a periodic box, or more."""
    if batch.periodic is not None and len(length):
        batch.periodic.refuse(repr(batch), f"link {int(length.argmax())} holds particles", float(length.max()), "links", True)


REST_LENGTH = Knob(Items(None, refuse_long, least=0.0, most=LARGEST), "Rest length [m].")


class Length(Quantity):
    """The distance of a pair, f(x) = |x_i - x_j|, and its gradients.

    Two particles in the same place have no direction between them; +x replaces it.
    """

    arity, is_distance = 2, True
    exchangeable = ((0, 1),)
    has_cusp_at_zero = precise = True

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return the lengths of the links, (m,)."""
        return np.linalg.norm(x[:, 0] - x[:, 1], axis=1)

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return the gradients, as measure() does."""
        r = x[:, 0] - x[:, 1]
        length = np.linalg.norm(r, axis=1, keepdims=True)
        n = np.divide(r, length, out=np.eye(1, r.shape[1]).repeat(len(r), axis=0), where=length > 0)
        return np.stack([n, -n], axis=1)

    @ti.func
    def excess(self, c, f):
        """Return |r| - rest = (r^2 - rest^2) / (|r| + rest), to all digits of the low words, where there are any."""
        rest = self.rest[c]
        C = f - rest
        if ti.static(self.state.carries):
            if f + rest > 0:
                r = self.state.between(self.corners.member(c, 0), self.corners.member(c, 1))
                goal = exact_rest(self, c)
                C = ti.cast(r.dot(r) - goal * goal, self.real) / (f + rest)
        return C

    @ti.func
    def measure(self, c, q):
        """Return |r| and +- r / |r|, with r = x_0 - x_1."""
        r = q[0, :] - q[1, :]
        length = ti.sqrt(r.dot(r))
        n = 0 * r
        n[0] = 1
        if length > 0:
            n = r / length
        return length, ti.Matrix.rows([n, -n])

    @ti.func
    def exact_excess(self, c):
        """Return f - rest in f64; the difference of two lengths in f32 loses digits."""
        r = self.state.between(self.corners.member(c, 0), self.corners.member(c, 1))
        return ti.sqrt(r.dot(r)) - exact_rest(self, c)


def is_link(feature: Any) -> "TypeGuard[Scalar]":
    """Whether a feature constrains lengths."""
    return isinstance(getattr(feature, "quantity", None), Length)
