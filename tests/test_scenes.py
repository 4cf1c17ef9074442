"""What must hold in every scene, asserted of those without contacts; and that the judges find what is wrong."""

import numpy as np
import pytest

from .fuzz.scenes import Set, Step
from .fuzz.trials import Find
from .properties import *  # noqa: F403

TOUCH = False


def test_a_scene_that_is_wrong_is_found_wrong(trials):  # noqa: F811
    # The judges themselves: energy that is brought in unseen, a particle beyond a wall, a lost momentum.
    name = "a rope swings from one end"
    trial = trials(name)
    push = Set(None, "velocity", np.full_like(trial.structure.position, 3.0))
    reports = list(trial.frames([Step(1 / 60), Set(None, "substeps", 20), Step(1 / 60)]))
    assert reports[-1].energy < reports[0].energy - reports[0].energy_change + 1e-6
    trial.world.velocity = push.value
    assert trial.world.step(1 / 60).energy > reports[-1].energy + 1.0
    beads = trials("beads collide in free space")
    with pytest.raises(Find, match="momentum|energy"):
        frames = beads.frames([Step(1 / 60)] * 3)
        next(frames)
        beads.world.velocity = beads.world.velocity + 1.0
        list(frames)
