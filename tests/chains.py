"""Chains with known answers, for tests of the direct solver."""

import numpy as np

import tiverlet as tv

from .conftest import case, pendulums, rms

PLANAR = ["D05_chain10", "D06_chain100", "D08_massratio10", "D09_massratio_inverted"]
PLANAR += [f"D07_massratio_1{'0' * k}" for k in (3, 4, 5, 6)]


def links(n, first=0):
    """Return the pairs of a chain of n links."""
    k = np.arange(n) + first
    return np.stack([k, k + 1], axis=1)


def beyond(name, t):
    """Return what a case gives for time t: indices of particles of the chain and their positions."""
    values = case(name)["values"][f"t{t}"]
    if "heavy_xy" in values:
        return np.array([2]), np.array([values["heavy_xy"]])
    xy = np.atleast_2d(values["xyz" if "xyz" in values else "xy"])
    at = np.array(values.get("nodes_1based", np.arange(len(xy)) + 1))
    return (at[-1:], xy[-1:]) if name.startswith("D08") else (at, xy)  # the figures of D08 are for its end mass


class Scene:
    """All cases with g = 9.81 as chains of one 3D world, which is compiled once."""

    def __init__(self):
        self.begin, x, v, mass, pairs, n = {}, [], [], [], [], 0
        for name in [*PLANAR, "S01_spherical_pendulum", "S02_chain5_3d", "S03_folded_chain"]:
            p = case(name)["params"]
            if name.startswith("S01"):
                at, m = np.array([[0, 0, 0], p["x0"]]), np.ones(2)
            elif name.startswith("S02"):
                at, m = np.array(p["x0"]), np.r_[1.0, p["masses"]]
            elif name.startswith("S03"):
                a = np.radians([0] * 10 + [90] + [180] * 10)
                at = np.vstack([[0, 0], np.cumsum(np.stack([np.sin(a), -np.cos(a)], axis=1) * p["l"], axis=0)])
                m = np.full(22, p["m"])
            else:
                at, m, _ = pendulums(name)
            flat = np.zeros((len(at), 3))
            flat[:, : at.shape[1]] = at
            speed = np.zeros_like(flat)
            speed[1:] = p.get("v0", 0.0) if name.startswith("S01") else 0.0
            self.begin[name] = n
            x, v, mass, pairs = [*x, flat], [*v, speed], [*mass, m], [*pairs, links(len(at) - 1, n)]
            n += len(at)
        self.particles = tv.Particles(
            np.vstack(x), velocity=np.vstack(v), mass=np.concatenate(mass), pinned=list(self.begin.values())
        )
        self.pairs = np.vstack(pairs)

    def error(self, w, name, t):
        at, want = beyond(name, t)
        return rms(w.position[self.begin[name] + at][:, : want.shape[1]], want)


def hung(world, name, **settings):
    x, mass, pairs = pendulums(name)
    features = [tv.Gravity(case(name)["params"]["g"]), tv.Distance(pairs)]
    return world(tv.Particles(x, mass=mass, pinned=[0]), features, precision="f64", solver=tv.Direct(), **settings)
