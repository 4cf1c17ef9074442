"""Scenes together in one world beside a Contact, which compiles once for all of them: the quick part of the matrix."""

import contextlib
from dataclasses import replace

import numpy as np

from ..fuzz.scenes import Call, Set, Structure
from ..fuzz.trials import Trial
from .scene import Run, Scene

# Arguments that are indices of particles, and those of particles.
INDICES = {"pairs", "triples", "quads", "hinges", "loops", "cells", "clusters", "indices"}
GIVEN = {"velocity": 0.0, "mass": 1.0, "radius": 0.0}


class Crowd:
    """Scenes of constraints in one world, with a Contact of groups that nobody is in. They are in one place: nothing touches.

    All of them begin with the same gravity.
    """

    def __init__(self, scenes: dict[str, Scene]):
        args: dict[str, list] = {name: [] for name in ("position", *GIVEN, "pinned")}
        features: list[Call] = []
        self.parts: dict[str, tuple[slice, list[int]]] = {}  # particles and features of each
        turns: dict[int, list[Set]] = {}
        n = 0
        for name, scene in scenes.items():
            x, given = scene.structure.position, scene.structure.particles.args
            args["position"].append(x)
            args["pinned"].append(n + np.asarray(given.get("pinned", ()), int))
            for what, usual in GIVEN.items():
                shape = x.shape if what == "velocity" else (len(x),)
                args[what].append(np.broadcast_to(given.get(what, usual), shape))
            numbers = []
            for call in scene.structure.features:
                here = Call(call.name, {k: n + np.asarray(v) if k in INDICES else v for k, v in call.args.items()})
                shared = call.name == "Gravity" and bool(features)  # the first feature
                numbers.append(0 if shared else len(features))
                features += [] if shared else [here]
            for k, some in scene.turns.items():
                turns.setdefault(k, []).extend(replace(one, of=numbers[one.of]) for one in some)
            self.parts[name] = slice(n, n + len(x)), numbers
            n += len(x)
        features.append(Call("Contact", {"groups": [(8, 9)]}))
        start = Call("Particles", {what: np.concatenate(values) for what, values in args.items()})
        together = Scene(Structure(start, tuple(features), {"path": "fused"}), [], max(s.frames for s in scenes.values()), turns)
        with contextlib.closing(Trial(together.structure)) as trial:
            self.run = Run(trial, together.events(), set())

    def of(self, name: str, frames: int) -> Run:
        """Return what was seen of one of the scenes, in its frames."""
        some, numbers = self.parts[name]
        return self.run.part(some, numbers, frames)
