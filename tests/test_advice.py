"""A property of advice: what a note says is done, and the flag is gone. Over all scenes of the catalogue."""

import contextlib
import re
import warnings
from dataclasses import dataclass
from typing import Any

import pytest

import tiverlet as tv
from tiverlet.step.diagnostics import risks
from tiverlet.step.integrator import CLOSE

from .fuzz.scenes import Set, Step, Structure
from .fuzz.trials import Trial, quiet
from .scenes import SCENES
from .scenes.scene import Scene

FRAMES, FEW = 45, 2  # frames of a scene, and substeps that are too few for half of all scenes
BRIEF = 3  # frames that a flag has after a blow, at most; a load lasts
TRIES = 3  # times that the advice for a flag is followed, at most: motion is another one with another number of substeps
NOTED = [*risks(*[0] * 14), "energy-gain", "energy-loss", "substeps-capped"]  # flags in the order of their notes
ABOUT = re.compile(r"(?:[Uu]se (?:about|up to|at least)|With|at first) (\d\S*?)[, .](?!\d)")
BLOW = re.compile(r"or up to (\d\S*) substeps after a blow")


@dataclass
class Advice:
    """What the notes of a flag say, of so many frames: about how many substeps, how many after a blow, whether in f64; and one of
    them."""

    frames: int = 0
    about: float = 0.0
    blow: float = 0.0
    double: bool = False
    note: str = ""

    def add(self, note: str) -> None:
        """Add the note of another frame."""
        self.frames += 1
        about, blow = ABOUT.search(note), BLOW.search(note)
        self.about = max(self.about, float(about[1]) if about else 0.0)
        self.blow = max(self.blow, self.about, float(blow[1]) if blow else 0.0)
        self.double, self.note = self.double or 'precision="f64"' in note, note


class Followed:
    """A scene by the solver that it has by default, in f32 until a note asks for f64."""

    def __init__(self, scene: Scene):
        self.scene, self.trials = scene, {}

    def close(self) -> None:
        """Free the memory of its worlds."""
        for trial in self.trials.values():
            trial.close()

    def trial(self, precision: str) -> Trial:
        """Return the compiled scene, in f32 or f64."""
        if precision not in self.trials:
            s = self.scene.structure
            kept = {k: v for k, v in s.settings.items() if k not in ("precision", "path", "solver", "order")}
            self.trials[precision] = Trial(Structure(s.particles, s.features, kept | {"precision": precision, "path": "fused"}))
        return self.trials[precision]

    def run(self, substeps: int, precision: str = "f32", ends: bool = False) -> dict[str, Advice]:
        """Return the flags of all frames, and what their notes advise. ends: whether forces of 1 / r^2 end at their centers."""
        trial, out = self.trial(precision), {}
        trial.reset()
        for event in self.scene.first:
            if not (isinstance(event, Set) and event.of is None and event.name == "substeps"):
                event.do(trial.world, trial.features)
        trial.world.substeps = substeps
        for force in trial.features:
            if ends and isinstance(force, tv.Attractor):  # where the substep resolves it: (omega h)^2 = h^2 strength / e^3
                force.softening = (abs(force.strength) / (60 * substeps) ** 2 / CLOSE) ** (1 / 3)
        for _ in range(FRAMES):
            report: Any = Step(1 / 60).do(trial.world, trial.features)
            for flag, note in zip(sorted(report.flags, key=NOTED.index), report.notes, strict=False):
                out.setdefault(flag, Advice()).add(note)
        return out


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_what_a_note_says_is_done_and_the_flag_is_gone(name):
    # At 2 substeps, half of all scenes have flags. For each flag, the substeps that its notes ask for: for loads where it lasts,
    # then for blows. What is placed off its constraints, and may so pass others, is told to be placed elsewhere.
    with warnings.catch_warnings(), contextlib.closing(Followed(SCENES[name])) as scene:
        quiet()
        flagged = scene.run(FEW)
        for flag in flagged:
            now, path = flagged, [FEW]
            while flag in now and len(path) <= TRIES:
                said = now[flag]
                if not said.about:
                    assert "lace" in said.note and "substeps" not in said.note, (flag, path, said)
                    break
                path.append(int(said.about if len(path) == 1 and said.frames > BRIEF else said.blow))
                now = scene.run(path[-1], "f64" if said.double else "f32", flag == "stiff-force")
            else:
                assert flag not in now, (flag, path, now[flag])
