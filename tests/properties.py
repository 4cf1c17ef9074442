"""What must hold in every scene of the catalogue. test_scenes.py and test_touching_scenes.py assert it, each of a half of them.

Two files, so that two processes share them; each compiles a scene once.
"""

import contextlib
from collections.abc import Iterator

import numpy as np
import pytest

from tiverlet.step import checkpoint

from .conftest import order, rms
from .fuzz import oracles
from .fuzz.scenes import Event, Set, Step, Structure
from .fuzz.trials import HARD, RISKS, Refused, Trial
from .fuzz.twins import WAYS, by_company, by_copies, by_path, by_threads
from .scenes import SCENES

__all__ = [
    "pytest_generate_tests",
    "trial",
    "test_under_no_schedule_of_substeps_a_scene_gains_energy",
    "test_a_scene_has_the_same_bits_however_it_is_run",
    "test_a_frame_that_is_undone_leaves_nothing_behind",
    "test_a_smooth_scene_is_second_order",
]
DRAWN = np.random.default_rng(0).random(60)
SCHEDULES = {  # substeps and dt of frame k
    "constant": lambda k: (None, 1 / 60),
    "random": lambda k: (int(2 * 32 ** DRAWN[k]), 1 / 60),
    "auto": lambda k: ("auto", 1 / 60),
    "uneven": lambda k: (8, 4 ** (DRAWN[k] - 0.5) / 60),
    "a hitch of 0.1 s": lambda k: (8, 0.1 if k == 30 else 1 / 60),
    "a hitch of 2 s": lambda k: (8, 2.0 if k == 30 else 1 / 60),
}
COMPILED = (by_path, by_threads, by_copies)  # ways that need kernels of their own: every second scene is tried in one of these
TOUCHING = {
    name for name, scene in SCENES.items() if {"Contact", "Polygons"} & {call.name for call in scene.structure.features}
}  # fmt: skip


def pytest_generate_tests(metafunc) -> None:
    """Give tests the scenes of their file: all as `name`, smooth ones as `smooth`."""
    some = [name for name, scene in SCENES.items() if (name in TOUCHING) == metafunc.module.TOUCH and not scene.known]
    for argument, names in (("name", some), ("smooth", [name for name in some if SCENES[name].smooth])):
        if argument in metafunc.fixturenames:
            metafunc.parametrize(argument, names)


@pytest.fixture
def trial(request, taichi) -> Iterator[Trial]:
    """Return the scene of a test, built anew; its kernels are those of the first time."""
    (name,) = (request.getfixturevalue(argument) for argument in ("name", "smooth") if argument in request.fixturenames)
    with contextlib.closing(Trial(SCENES[name].structure)) as built:
        yield built


def is_rigid(structure: Structure) -> bool:
    """Whether a structure stores energy in heights and motion alone."""
    plain = {"Gravity", "Distance", "Rope", "Contact", "HalfSpace", "Box"}
    soft = any("compliance" in call.args for call in structure.features)
    return {call.name for call in structure.features} <= plain and not soft and "spin" not in structure.particles.args


def told(trial: Trial) -> float:
    """Return the energy of such a scene by the velocities that are read [J]."""
    w, free = trial.world, trial.free > 0
    g = sum(np.asarray(f.kernel_values()["g"]) for f in trial.features if type(f).__name__ == "Gravity")
    return float(
        (w.particles.mass * ((w.velocity**2).sum(axis=1) / 2 - w.position @ (g + np.zeros(w.position.shape[1]))))[free].sum()
    )


def scheduled(name: str, schedule, frames: int = 60) -> Iterator[Event]:
    """Yield what happens in a scene under a schedule of substeps and dt."""
    yield from SCENES[name].first
    for k in range(frames):
        substeps, dt = schedule(k)
        if substeps:
            yield Set(None, "substeps", substeps)
        yield Step(dt)


@pytest.mark.slow
def test_under_no_schedule_of_substeps_a_scene_gains_energy(trial, name):
    # Every frame is judged: residual, overlap and walls by brute force, momentum of what is closed. Beyond that, passive scenes
    # never have more than at the start, to a thousandth of the heights that they pass, m g L, and of their kinetic energy. By the
    # velocities that are read it is the same, to the work in a substep, v a h, also where loads cancel in braced bodies.
    off = []
    for label, schedule in SCHEDULES.items():
        start, energies, flags, trial.world.substeps = None, [], set(), None
        usual = trial.world.substeps
        low = high = trial.structure.position
        for report in trial.frames(scheduled(name, schedule), HARD):
            start = report.energy - report.energy_change if start is None else start
            energies.append(report.energy)
            flags |= report.flags
            assert label != "auto" or report.substeps >= usual
            x = trial.world.position
            low, high = np.minimum(low, x), np.maximum(high, x)
            if label == "constant":
                assert report.flags <= SCENES[name].flags, report.notes
                off.append(abs(told(trial) - report.energy) if is_rigid(trial.structure) else 0.0)
        if not oracles.passive(trial.structure) or (label == "a hitch of 2 s" and flags & {*RISKS, "energy-gain"}):
            continue  # a frame of 2 s may be wrong, but not silently
        w, v = trial.world, np.asarray(trial.structure.particles.args.get("velocity", 0.0))
        low, high = low.min(axis=0), high.max(axis=0)
        high = np.maximum(high, low + w.particles.size)
        size = oracles.height(trial.features, w.particles, trial.free, low, high)
        size += (w.particles.mass[trial.free > 0][:, None] * np.broadcast_to(v, x.shape)[trial.free > 0] ** 2).sum() / 2
        assert label != "constant" or max(off) < (0.3 if "softened" in flags else 0.05) * size
        worst = int(np.argmax(energies))
        share = 0.02 if label == "auto" else 1e-3  # "auto" repeats frames whose energy is wrong by a fiftieth
        assert energies[worst] <= start + share * size, (label, worst, (energies[worst] - start) / size, flags)


@pytest.mark.slow
def test_a_scene_has_the_same_bits_however_it_is_run(trial, name):
    # As a clone, from a recording, with a particle far away that comes and goes; as a copy among many, on a team of threads or
    # in many launches. What is asked of it on the way changes nothing and is right. The length of the substep changes in turns,
    # since velocities and loads depend on the last one: all of that is state.
    number = list(SCENES).index(name)
    compiled = None if number % 2 else COMPILED[number // 2 % len(COMPILED)]
    turns = [event for n in (20, 3, 20, 3, 20) for event in (Set(None, "substeps", n), Step(1 / 60))]
    events = [*SCENES[name].first, *turns]
    # What moves further than the skin meets only what is listed, and edits make lists anew.
    left_out = {*COMPILED} - {compiled} | ({by_company} if "tunnelling-risk" in SCENES[name].flags else set())
    for way in WAYS:
        if way not in left_out:
            with contextlib.suppress(Refused):  # by what says that it is for one world, as Sleep
                way(trial, events)


@pytest.mark.slow
def test_a_frame_that_is_undone_leaves_nothing_behind(trial, name):
    # Neither one that was right nor one in which all is NaN, which is flagged.
    trial.replay([*SCENES[name].first, Step(1 / 60)])
    w, state = trial.world, trial.world._runner.scene.state
    kept, flags = checkpoint.keep(w), checkpoint.flags(w)
    w.step(1 / 60)
    after = w.hash()
    for spoilt in (False, True):
        checkpoint.undo(w, kept, flags)
        if spoilt:
            memory = w._runner.memory
            for field in (state.x, state.d):
                memory.write(field, np.full_like(memory.read(field), np.nan))
            assert "non-finite" in w.step(1 / 60).flags
            checkpoint.undo(w, kept, flags)
        report = w.step(1 / 60)
        assert w.hash() == after and np.isfinite([report.energy, report.residual, report.overlap]).all()


def test_a_smooth_scene_is_second_order(trial, smooth):
    ends = []
    for substeps in (10, 20, 40, 80):
        trial.replay([*SCENES[smooth].first, Set(None, "substeps", substeps), *[Step(1 / 60)] * 20])
        ends.append(trial.world.position)
    assert 1.85 <= order([rms(a, b) for a, b in zip(ends[1:], ends[:-1], strict=True)]) <= 2.15
