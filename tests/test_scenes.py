"""What must hold in every scene, asserted of those without contacts; and that the judges find what is wrong."""

import contextlib

import pytest

from .fuzz.scenes import Step
from .fuzz.trials import Find, Trial
from .properties import *  # noqa: F403
from .scenes import SCENES

TOUCH = False


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, of, what, change",
    [
        ("energy", "a rope swings from one end", "velocity", 3.0),
        ("momentum", "beads collide in free space", "velocity", 1.0),
        ("wall", "planks land upright on a rough floor", "position", (0.0, -1.0)),
    ],
)
def test_a_scene_that_goes_wrong_unseen_is_found(taichi, kind, of, what, change):
    # The judges themselves: energy that is brought in, a lost momentum, particles beyond a wall.
    with contextlib.closing(Trial(SCENES[of].structure)) as trial, pytest.raises(Find, match=f"^{kind}:"):
        frames = trial.frames([Step(1 / 60)] * 3, {kind})
        next(frames)
        setattr(trial.world, what, getattr(trial.world, what) + change)
        list(frames)
