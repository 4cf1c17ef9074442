"""How far a way is free, where nothing but a distance is known."""

from collections.abc import Callable

import numpy as np

STEPS = 2048  # along a ray, at most
FINE = 2.0**-24  # of the size of the scene: no step is shorter; what is thinner may be missed
FAR = 1e16  # [m] where particles cannot be any more
HALVES = 40  # of the step in which the surface lies


def march(clearance: Callable[[np.ndarray], np.ndarray], origin: np.ndarray, direction: np.ndarray, radius: float) -> np.ndarray:
    """How far rays go until clearance() falls to `radius` from above, (k,) [m], inf where it does not in STEPS steps.

    Sphere tracing (Hart 1996): each step is as long as there is nothing for certain, which takes a distance that changes no
    faster than the place. A ray that starts in the wall is followed out of it first. The step in which the surface was passed is
    halved until there is nothing left of it.
    """
    gap = clearance(origin) - radius
    fine = FINE * np.maximum(np.maximum(np.abs(origin).max(axis=1), np.abs(gap)), radius)
    fine = np.where(fine > 0, fine, FINE)
    t, low, high = np.zeros(len(origin)), np.full(len(origin), np.nan), np.full(len(origin), np.inf)
    # What starts on the surface has been outside if it goes in, which it does if it is in after the first step.
    was = gap > -fine
    for _ in range(STEPS):
        going = np.flatnonzero(np.isinf(high) & (t < np.inf))
        if not len(going):
            break
        before = t[going]
        with np.errstate(over="ignore"):
            t[going] = before + np.maximum(np.abs(gap[going]), fine[going])
        far = t[going] > FAR
        t[going[far]] = np.inf
        going, before = going[~far], before[~far]
        gap[going] = clearance(origin[going] + t[going, None] * direction[going]) - radius
        now = gap[going] > 0
        hit = was[going] & ~now
        low[going[hit]], high[going[hit]] = before[hit], t[going[hit]]
        was[going] = now
    hit = np.flatnonzero(high < np.inf)
    for _ in range(HALVES):
        middle = (low[hit] + high[hit]) / 2
        out = clearance(origin[hit] + middle[:, None] * direction[hit]) > radius
        low[hit], high[hit] = np.where(out, middle, low[hit]), np.where(out, high[hit], middle)
    return np.where(high < np.inf, low, np.inf)
