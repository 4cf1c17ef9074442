"""Scenes that the fuzzer found and that are fixed: each is run, judged, and run again."""

import numpy as np

import tiverlet as tv

from .scenes import Call, Event, Set, Step, Structure, cloud

FRAME = Step(1 / 60)


def of(position, *features: Call, settings: dict | None = None, **particles) -> Structure:
    """Return a structure, written briefly."""
    return Structure(Call("Particles", {"position": np.asarray(position), **particles}), features, settings or {"path": "fused"})


K = np.arange(8)
PAIRED = cloud(8, 3)[K // 2]  # two in each place
MASSES = 10.0 ** np.linspace(-1, 1, 8)[np.argsort(tv.golden(K))]
FINDS: dict[str, tuple[Structure, list[Event]]] = {
    "soft angles that get their direction in a later pass": (
        of(
            PAIRED,
            Call("Contact", {"friction": 1e6, "restitution": 1.0, "groups": [(0, 1)]}),
            Call("Pin", {"indices": [1]}),
            Call("AngleLimit", {"triples": np.stack([K[:-2], K[1:-1], K[2:]], axis=1), "lower": 0.0, "upper": 0.0,
                                "compliance": np.where(K[:-2] % 2, 1.0, 0.0)}),
            settings={"precision": "f32-compensated", "path": "fused", "solver": Call("Chebyshev", {})}, radius=0.1, pinned=[0],
            mass=MASSES,
        ),
        [Set(None, "substeps", 4), Set(None, "iterations", 2), FRAME, Set(1, "target", PAIRED[[1]] + 0.05), FRAME],
    ),
    "a rest length turned for the first time": (
        of([[0.0, 0], [1, 0]], Call("Distance", {"pairs": [[0, 1]], "compliance": 1e-3}), Call("Gravity", {"g": 9.81})),
        [Set(None, "substeps", 4), FRAME, FRAME, Set(0, "rest", 0.9), FRAME],
    ),
}  # fmt: skip
