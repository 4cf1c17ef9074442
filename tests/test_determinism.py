"""The same bits on any number of threads and on all paths; and features that are absent cost nothing."""

import pathlib
from types import SimpleNamespace

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.device.patches.compiler import BRIEF, LEAN
from tiverlet.step import build, diagnostics, step

from .conftest import python
from .launches import launches

SOLVE = "solve_constraints solve_systems update_multipliers apply_constraints"  # the same where links answer contacts: Direct


@pytest.mark.slow
def test_what_a_gpu_sums_up_is_the_same(world, monkeypatch):
    # A GPU sums by 64^2 blocks and then 64, a CPU by 64: the same figures, up to the rounding of a sum of n numbers. Of a crowded
    # state that no frame has made, so that only the sums are compiled.
    x = 1.0 * tv.golden(np.arange(200), dim=2) - 0.5
    reports = []
    for architecture in ("cpu", "cuda"):
        monkeypatch.setattr(diagnostics, "runtime", SimpleNamespace(architecture=lambda a=architecture: a))
        features = [tv.Gravity(9.81), tv.Distance([[0, 1]]), tv.Contact()]
        w = world(tv.Particles(x, velocity=-4 * x, radius=0.04), features, path="launched")
        assert w._runner.diagnostics.blocks == (64 if architecture == "cpu" else 64**2)
        w._runner.list_neighbours()
        w._runner.diagnose_state()
        reports.append((w._runner.report(), w._runner.diagnostics.report.figures.copy()))
    (one, figures), (two, others) = reports
    assert abs(one.energy - two.energy) <= 200 * 2.0**-53 * 200 * 9.81 * 2 and one.energy > 100
    assert one.contacts > 100 and one.overlap > 0.1 and (one.overlap, one.contacts) == (two.overlap, two.contacts)
    np.testing.assert_allclose(figures, others, rtol=1e-12)  # all that is summed up, and the largest of all that is


@pytest.mark.slow
def test_systems_have_the_same_bits_on_1_and_8_threads():
    # Sums over all constraints, as conjugate gradients compute them beside contacts, and systems that several threads solve:
    # cloth that falls on a ball, with hail on it, and ropes. On one thread they run phase by phase, as on a GPU. Jacobi is
    # tested on all paths below, Chebyshev in test_solvers.py. Compiled as small worlds are: a third of the time, the same bits.
    code = """
import numpy as np
import pytest
from tiverlet.device import ti
from tiverlet.device.patches.compiler import BRIEF
from tiverlet.step import build
import tiverlet as tv
build._passes = lambda *_: BRIEF
k = np.arange(900).reshape(30, 30)
net = np.vstack([np.stack([k[:, :-1].ravel(), k[:, 1:].ravel()], 1), np.stack([k[:-1].ravel(), k[1:].ravel()], 1)])
ropes = np.stack([k[:, :-1].ravel(), k[:, 1:].ravel()], 1)
cloth = np.stack([k // 30, 30 + 0 * k, k % 30], axis=2).reshape(-1, 3) / 30.0
hail = cloth[31::60] + [0.016, 0.04, 0.016]
start = tv.Particles(
    np.vstack([cloth, hail]), velocity=np.repeat([[0.0, 0, 0], [0, -1, 0]], [900, len(hail)], axis=0), radius=0.0166,
    pinned=[0, 870],
)
def results(path):
    touching = [tv.Ball((0.5, 0.69, 0.5), 0.3, friction=0.3), tv.Contact(friction=0.3)]
    for solver, pairs, more in (
        (tv.Direct(), ropes, []), (tv.ConjugateGradient(steps=4), net, touching),
    ):
        features = [tv.Gravity(9.81), tv.Distance(pairs), *more]
        with tv.World(start, features, solver=solver, path=path, substeps=5, iterations=4) as world:
            met = sum(world.step(1 / 60).contacts for _ in range(6))
            assert met > 10 or not more
            print(world.hash())
for threads in (1, 8):
    tv.init(threads=threads)
    results("parallel")
    ti.reset()
"""
    made = python(code).stdout.split()
    assert len(made) == 4 and made[0] != made[1] and made[:2] == made[2:]


@pytest.mark.slow
def test_a_large_pile_has_the_same_bits_on_all_paths_and_where_a_team_breaks_up(world, monkeypatch):
    # From 1000 particles on, blocks of particles are tested for any contact. If every wait of a team is a long one, the first
    # thread continues alone after a few waits, and the others come back 32 frames later. One path is compiled as large worlds
    # are, the other as small ones are: a third of the time, with the same bits. test_grid.py tests the launched path.
    k = np.arange(1200)
    x = np.stack([k % 30 * 1.02, k // 30 * 1.02], axis=1) + 0.5 + 0.01 * tv.golden(k, dim=2)
    made = []
    for path, patience in (("fused", 0), ("parallel", 0), ("parallel", -1)):
        features = [tv.Gravity(9.81), tv.Box((0, 0), (31, 60)), tv.Contact()]
        monkeypatch.setattr(build, "_passes", lambda *_, settings=LEAN if path == "fused" else BRIEF: settings)
        w = world(tv.Particles(x, radius=0.5), features, path=path, substeps=3)
        if patience:
            w._runner.step.team.patience_number.set(patience)
        alone = [w.step(1 / 60) and w._runner.sheet[step.ACTIVE_THREADS] == 1 for _ in range(40)]
        assert not patience or w._runner.step.team.size == 1 or all(alone)
        assert w.last.contacts > 1000
        made.append(w.hash())
    assert len(set(made)) == 1


@ti.func
def wild(x, v, t):
    """A force that turns velocities below 5 m, and brakes them by a rate that changes with time."""
    return ti.select(x[1] > 5.0, 0.0, 3.0) * ti.Vector([v[1], -v[0]]) - (0.2 + 0.1 * ti.sin(t)) * v.norm() * v


@ti.func
def apart(r):
    """A pair force that ends at a distance of 0.2 m."""
    return 0.02 * r * (0.04 - r.dot(r))


@pytest.mark.slow
def test_all_paths_have_the_same_bits(world):
    # Forces, walls and constraints; contacts, spins, events and sleep are in test_sleep.py, three dimensions in the fuzzer. The
    # particles of a column fall on the box.
    n = 160
    x = tv.golden(np.arange(n), dim=2) * [4, 1.6]
    x[:4] = [1.0, 7.0] + np.outer(np.arange(4), [0.0, 0.16])
    pairs = np.stack([np.arange(8, n - 1, 2), np.arange(9, n, 2)], axis=1)
    soft, made = np.where(np.arange(len(pairs)) % 2, 1e-4, 0.0), []
    for path in ("fused", "parallel", "launched"):
        links = tv.Distance(pairs, compliance=soft, damping=1.0, break_at=np.where(soft > 0, 200.0, np.inf))
        features = [
            tv.Gravity(9.81), tv.Drag(0.1), tv.Force(wild), tv.Hand((1.0, 1.0), 7), tv.PairForce(apart, 0.2),
            tv.Box((0, 0), (4, 9)), tv.HalfSpace((0.2, 1), 0.1), links, tv.Rope(pairs[:20] + 50, 0.5), tv.Pin([0]),
            tv.Pin([4], (1, 1), compliance=1e-3), tv.Pin([5], (1, 2)),
        ]  # fmt: skip
        start = tv.Particles(x, radius=0.08, mass=1 + np.arange(n) % 5)
        w = world(start, features, path=path, precision="f32-compensated", substeps=7, iterations=2)
        w.run(0.3)
        w.substeps = 9
        w.run(0.2)
        made.append((w.hash(), w.last.energy, w.last.residual, w.last.overlap))
        assert 0 < links.broken.sum() < len(pairs)
    assert made[0] == made[1] == made[2]


def test_what_is_no_number_is_hashed_alike(world):
    # The sign of inf - inf depends on the order in which a compiler takes the operands, which may differ between paths.
    w = world(tv.Particles(np.zeros((2, 2))), [])
    w.step(1 / 60)
    memory, d, told = w._runner.memory, w._runner.scene.state.d, []
    for values in ([[np.nan, 1], [0, 0]], [[-np.nan, 1], [0, 0]], [[np.nan, 2], [0, 0]]):
        memory.write(d, np.array(values))
        told.append(w.hash())
    assert told[0] == told[1] != told[2]


@pytest.mark.filterwarnings("ignore:Contact. all radii are 0")
def test_what_is_absent_has_no_field_and_no_kernel(world):
    # A point in free flight has position, displacement, mass and counts. Each feature adds its own fields and nothing else.
    plain = world(tv.Particles(np.zeros((10, 2))), [])
    names = {name.split(".")[0] for name in plain.fields}
    assert names == {"position", "displacement", "inv_mass", "numbers"}
    adds = {
        "Gravity": ([tv.Gravity(1.0)], {"Gravity"}),
        "Drag": ([tv.Drag(1.0)], {"decay"}),
        "Wind": ([tv.Wind((1, 0), 1.0)], {"Wind", "decay"}),
        "Box": ([tv.Box((-1, -1), (1, 1))], {"Box", "radius", "thrust"}),
        "HalfSpace": ([tv.HalfSpace((0, 1), -1)], {"HalfSpace", "radius", "thrust"}),
        "Polygon": ([tv.Polygon([[1, 1], [2, 1], [1, 2]])], {"Polygon", "radius", "thrust", "position_at_start"}),
        "Pin": ([tv.Pin([0])], {"Pin"}),
        "Distance": ([tv.Distance([[0, 1]], 0.1)], {"Distance", "slots", "position_low", "displacement_low"}),
        "empty Distance": ([tv.Distance(np.zeros((0, 2), int))], set()),
        "Contact of points": ([tv.Contact()], set()),
    }
    for name, (features, fields) in adds.items():
        w = world(tv.Particles(np.zeros((10, 2))), features)
        assert {field.split(".")[0] for field in w.fields} - names == fields, name
    rigid = world(tv.Particles(np.zeros((10, 2))), [tv.Distance([[0, 1]], 0.1)])
    soft = world(tv.Particles(np.zeros((10, 2))), [tv.Distance([[0, 1]], 0.1, compliance=1.0)])
    only = set(soft.fields) - set(rigid.fields)
    assert only == {"Distance.compliance", "Distance.last", "Distance.history", "Distance.offset"}


@pytest.mark.slow
def test_launches_count_what_the_scene_needs(world):
    # Kernel launches of a frame, counted at Taichi's entry point: one on a CPU; otherwise one per pass of a substep. There are as
    # many particles as in the next test, which uses the kernels again.
    x = np.array([[0.0, 0.0], [1.0, 0.0], *([0.5 * k, 5.0] for k in range(198))])
    for features, path, expected in (
        ([tv.Gravity(1.0)], "launched", {"integrate": 5, "measure": 1}),
        (
            [tv.Gravity(1.0), tv.Distance([[0, 1]]), tv.Contact(friction=0.1, restitution=0.5)],
            "launched",
            {
                f"integrate ask_for_list {SOLVE}": 5,
                "ask_for_list start_events find_rows": 5,
                "ask_for_impulses finish_impulses": 5,  # after as many passes as in the frame before, none
                "ask_for_places apply_corrections": 5,
                f"ask_for_list {SOLVE}": 5,
                "ask_for_list apply_corrections": 5,
                "ask_for_list": 1,
                "measure": 1,
            },
        ),
        ([tv.Gravity(1.0), tv.Distance([[0, 1]])], "fused", {"fused": 1}),
    ):
        w = world(tv.Particles(x, radius=0.1), features, path=path, substeps=5, iterations=2)
        w.step(0.01)
        w.step(0.01)
        with launches() as count:
            w.step(0.01)
        assert count == expected
        total = "1 launch" if path != "launched" else f"{count.total()} launches"
        assert f"{total} per frame" in w.explain()


@pytest.mark.slow
def test_the_host_asks_once_in_a_frame(world):
    # Launched phase by phase, as on a GPU, the host does not wait for launches. It reads the result of the frame. Where the
    # neighbour list is stale, it also reads whether the new list fits, and the result of the frame that continues from there.
    features = [tv.Gravity(0.0), tv.Distance([[0, 1]]), tv.Contact(friction=0.5, restitution=0.5)]
    x = 1.8 * tv.golden(np.arange(200), dim=2) - 0.9
    w = world(tv.Particles(x, velocity=-2 * x, radius=0.04), features, path="launched", substeps=8, iterations=2)
    w.run(0.2)
    built, frames = w._runner.list_neighbours, 10
    lists: list[None] = []
    w._runner.list_neighbours = lambda: (lists.append(None), built())
    with launches() as count:
        for _ in range(frames):
            w.step(1 / 60)
    assert count["measure"] == frames + len(lists) and count["build_list"] == len(lists) > 0
    assert count.answers == count["measure"] + count["build_list"]


@pytest.mark.slow
def test_unused_files_change_no_bit(tmp_path):
    # The same scene with the files of other features deleted from the package, and their names from its lists.
    import shutil

    package = pathlib.Path(tv.__file__).parent
    bare = tmp_path / "bare" / "tiverlet"
    shutil.copytree(package, bare)
    gone = {"forces": ["attractor", "drag", "pair_force", "force", "wind"], "constraints": ["rope", "spacer"]}
    for folder, files in gone.items():
        init = bare / folder / "__init__.py"
        text = init.read_text()
        for name in files:
            (bare / folder / f"{name}.py").unlink()
            title = name.title().replace("_", "")
            text = text.replace(f"from .{name} import {title}\n", "").replace(f'"{title}", ', "").replace(f', "{title}"', "")
        init.write_text(text)
    init = bare / "__init__.py"
    text = init.read_text()
    for title in ("Attractor", "Drag", "PairForce", "Force", "Wind", "Rope", "Spacer"):
        text = text.replace(f'"{title}", ', "").replace(f"{title}, ", "").replace(f", {title}\n", "\n")
        text = text.replace(f"    {title},\n", "")
    init.write_text(text)
    code = """
import sys
sys.path.insert(0, {path!r})
import numpy as np
import pytest
import tiverlet as tv
assert tv.__file__.startswith({path!r})
i = np.arange(39)
x = np.stack([np.arange(40) * 0.05, np.zeros(40)], axis=1)
w = tv.World(tv.Particles(x, radius=0.02, pinned=[0]), [tv.Gravity(9.81), tv.Distance(np.stack([i, i + 1], 1)), tv.Contact(),
             tv.Box((-3, -1), (3, 3))], solver=tv.Jacobi())
w.run(1.0)
print(w.hash())
"""
    whole = python(code.format(path=str(package.parent))).stdout
    assert len(whole.strip()) == 64
    assert whole == python(code.format(path=str(bare.parent)), fresh=True).stdout


def test_explain_names_what_is_in_and_what_is_out(world):
    w = world(
        tv.Particles([[0.0, 0], [1, 0], [2, 0]], pinned=[0, 1]),
        [tv.Gravity(), tv.Distance([[0, 1], [1, 2]])],
        iterations=3,
    )
    text = w.explain()
    for part in (
        "3 particles in 2D, 2 static; f32 on cpu", "20 substeps x 3 iterations, path fused: 1 launch per frame",
        "Distance: 2 constraints, 1 of them between particles that cannot move", "grid, neighbour list, contacts: no Contact",
        "every constraint is rigid", "breaks counted: no constraint has break_at", "Constraint corners that can move: 1 of 4",
    ):  # fmt: skip
        assert part in text
    stated = int(text.split(" fields, ")[1].split(" bytes")[0])
    assert stated == sum(w.fields.values())


def test_explain_tells_of_a_numbering_that_costs_time(world):
    lattice = np.stack(np.divmod(np.arange(10_000), 100), axis=1) * 1.0
    mixed = np.random.default_rng(1).permutation(lattice)
    for x, told in ((lattice, False), (mixed, True), (tv.shapes.Shape(mixed).in_order().position, False), (mixed[:9999], False)):
        assert ("Numbered at random" in world(tv.Particles(x), []).explain()) == told
