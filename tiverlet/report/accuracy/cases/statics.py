"""Ropes, beams and nets that come to rest: errors of the equilibrium, in positions or relative."""

from typing import Any

import numpy as np

from ....constraints import Bend, Distance
from ....device import ti
from ....forces import Drag, Force, Gravity
from ....particles import Particles
from ....shapes import net
from .case import Case, Limits, Scene, ends_at, known, links

RATE = 4.0  # [1/s] of the drag that brings scenes to rest; after 10 s exp(-20) of a swing is left
FINER: dict[str, Any] = {"efforts": (10, 20, 40, 80, 160)}  # for scenes that need more substeps for the order of Jacobi
SETTLED: dict[str, Any] = {"conserves": False, "trusted": 3e-9, "efforts": (5, 10, 20, 40, 80)}


def rope(n: int, length: float, span: float, alpha: float) -> Scene:
    """Build a rope of n links between two pins of the same height, released as a V."""
    t, depth = np.linspace(0, 1, n + 1), np.sqrt(length**2 - span**2) / 2
    x = np.stack([span * t, -depth * (1 - np.abs(2 * t - 1))], axis=1)
    link = Distance(links(n), length / n, compliance=alpha)
    return Particles(x, mass=0.1, pinned=[0, n]), [Gravity(9.81), link, Drag(RATE)]


def sags(name: str, key: str, n: int, length: float, span: float, alpha: float, limit: Limits, **more) -> Case:
    """Return the case of a hanging rope: the relative error of its sag."""
    values = known(name)["values"]
    sag = (values[key] if key else values)["sag"]
    what = f"Elastic rope of {n} links, {alpha:g} m/N" if alpha else f"Rope of {n} rigid links between two pins"
    return Case(
        f"{name}:{key}" if key else name, what, lambda: rope(n, length, span, alpha), 10.0,
        lambda run: abs(float(-run.world.position[:, 1].min()) / sag - 1), limit, 0.1, "relative", **(SETTLED | more),
    )  # fmt: skip


def stretches(name: str, limit: Limits, **more) -> Case:
    """Return the case of an elastic chain that hangs straight down: the relative error of its elongation
    alpha m g N (N + 1) / 2."""
    p, v = known(name)["params"], known(name)["values"]
    n, length = p["links"], p["links"] * p["rest"]
    start = Particles(np.stack([np.zeros(n + 1), -p["rest"] * np.arange(n + 1)], axis=1), mass=p["m"], pinned=[0])
    return Case(
        name, f"Elastic chain of {n} links, {p['alpha']:g} m/N, hanging",
        lambda: (start, [Gravity(p["g"]), Distance(links(n), p["rest"], compliance=p["alpha"]), Drag(2.0)]), 20.0,
        lambda run: abs(float(-run.world.position[-1, 1] - length) / v["total_elongation"] - 1), limit, 1.0, "relative",
        methods=("Direct", "Jacobi"), **SETTLED, **more,
    )  # fmt: skip


@ti.func
def _pull(x, v, t, i):
    """Return 1 N downward at the tip of the cantilever."""
    out = 0 * x
    if i == 11:
        out[1] = -1.0
    return out


def cantilever() -> Scene:
    """Build S06: a clamped strip of ten rigid links with angular springs, and a force at its tip."""
    n = 10
    k = np.arange(n)
    x = np.stack([(np.arange(n + 2) - 1) / n, np.zeros(n + 2)], axis=1)
    bend = Bend(np.stack([k, k + 1, k + 2], axis=1), 0.0, compliance=1 / n)
    strip = Distance(np.stack([k + 1, k + 2], axis=1))
    return Particles(x, mass=0.3, pinned=[0, 1]), [Force(_pull), strip, bend, Drag(3.0)]


def hollows(n: int, alpha: float, limit: Limits, **more) -> Case:
    """Return the case of a net in a pinned frame of 1 m under its weight: the relative error of the sag of its middle."""
    key, flat = f"n{n}_alpha{alpha:g}", net((0, 0, 0), (1, 0, 0), (0, 0, 1), (n + 1, n + 1))
    want = known("S08_net_sag")["values"][key]["center_y"]
    start = Particles(flat.position, mass=1 / n**2, pinned=(flat.position[:, [0, 2]] % 1 == 0).any(axis=1))
    return Case(
        f"S08_net_sag:{key}", f"Net of {n} x {n} cells, {alpha:g} m/N",
        lambda: (start, [Gravity(9.81), Distance(flat.links, 1 / n, compliance=alpha), Drag(RATE)]), 12.0,
        lambda run: abs(float(run.world.position[(n + 1) ** 2 // 2, 1]) / want - 1), limit, 1.0, "relative",
        methods=("CG x 20", "Jacobi"), **{**SETTLED, **FINER, **more},
    )  # fmt: skip


TIP = known("S06_cantilever_elastica")["values"]["N10_FL2_EI_1.0"]
ELASTIC = {"methods": ("Direct", "Jacobi"), "efforts": (5, 10, 20, 40, 80, 160)}
CATENARY = {"methods": ("Direct", "Jacobi"), "order": None}

CASES = [
    Case(
        "S06_cantilever_elastica", "Clamped strip with a force at its tip", cantilever, 15.0,
        ends_at([-1], [[TIP["tip_x"], TIP["tip_y"]]]), (2e-5, 2e-5), methods=("Jacobi x 10", "Jacobi"), **SETTLED,
    ),
    sags("S07_elastic_catenary", "N10_alpha1e-3", 10, 1.0, 0.8, 1e-3, (1e-9, 4e-8), **ELASTIC),
    sags("S07_elastic_catenary", "N20_alpha1e-4", 20, 1.0, 0.8, 1e-4, (1e-9, 1e-7), **ELASTIC),
    hollows(10, 0.01, (2e-9, 5e-7)),
    hollows(10, 0.001, (1e-8, 1e-6)),
    sags("R10b_discrete_catenary_N10", "", 10, 10.0, 6.0, 0.0, (1e-9, 2e-8), **CATENARY),
    sags("R10b_discrete_catenary_N20", "", 20, 10.0, 6.0, 0.0, (1e-9, 1e-7), **CATENARY),
    sags("R10b_discrete_catenary_N100", "", 100, 10.0, 6.0, 0.0, (1e-9, 2e-7), **CATENARY),
    stretches("R11_elastic_rope_N10_alpha1e-3", (4e-9, 1e-6), order=None),
    stretches("R11_elastic_rope_N32_alpha1e-3", (1e-8, 5e-7), order=None),
    stretches("R11_elastic_rope_N100_alpha1e-5", (5e-9, 2e-6), order=None),
]  # fmt: skip
