"""What every constraint of one number must do, tested for all at once: a new constraint is one row of ROWS in rows.py.

Each row makes one world of many blocks. Each block has the same corners and tests something else; blocks do not touch.
"""

from functools import cached_property

import numpy as np
import pytest

import tiverlet as tv
from tiverlet import constraints
from tiverlet.step import checkpoint

from . import bad_starts
from .conftest import order, rms, unprojected
from .rows import OTHERS, PATH, ROWS, TETRA, WINGS, Row

BLOCKS = ("met", "off", "turned", "held", "stuck", "soft", "free", "swing", "loaded", "weak")
MASS = np.array([1.0, 2.5, 0.7, 4.0])
IN_BATCHES = ("Bend 3D", "Volume of surfaces")  # tested in two batches of one world, see Row.like


class Scene:
    """The blocks of one row."""

    def __init__(self, world, row: Row):
        self.row, (self.arity, self.dim) = row, row.points.shape
        a = 0.6
        self.turn = np.eye(self.dim)
        self.turn[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
        if self.dim == 3:
            self.turn = np.roll(np.roll(self.turn, 1, axis=0), 1, axis=1) @ self.turn
        k, m = self.arity, len(BLOCKS)
        self.corners = np.arange(m * k).reshape(m, k)
        x = np.tile(row.points, (m, 1, 1))
        x[BLOCKS.index("turned")] = x[0] @ self.turn.T + 0.5 * row.internal
        v = np.zeros_like(x)
        spin = np.random.default_rng(1).normal(size=x[0].shape) * 0.7
        v[BLOCKS.index("free")] = v[BLOCKS.index("swing")] = spin
        self.mass = np.tile(MASS[:k], m)
        pinned = np.zeros((m, k), dtype=bool)
        pinned[BLOCKS.index("held"), 0] = k > 1
        pinned[BLOCKS.index("stuck")] = True
        pinned[[BLOCKS.index(b) for b in ("loaded", "weak")], :-1] = True
        alpha, damping, strength = np.zeros(m), np.zeros(m), np.full(m, np.inf)
        alpha[[BLOCKS.index(b) for b in ("soft", "swing", "loaded", "weak")]] = 1e-2, 2e-2, 1e-2, 1e-2
        load = abs(row.off) / 10 / 1e-2
        strength[BLOCKS.index("loaded")], strength[BLOCKS.index("weak")] = 1.1 * load, 0.9 * load
        damping[BLOCKS.index("soft")] = 3.0
        self.compliance, self.x, self.v = alpha, x.reshape(-1, self.dim), v.reshape(-1, self.dim)
        probe = row.make(self.corners, np.zeros(m))
        probe.prepare(tv.Particles(self.x), np.ones(m * k))
        f = probe.violation(self.x)  # f - 0, as every block sees it
        rest = f.copy()
        rest[[BLOCKS.index(b) for b in ("off", "turned", "held", "soft")]] -= row.off
        rest[[BLOCKS.index(b) for b in ("loaded", "weak")]] -= row.off / 10
        self.feature = row.make(self.corners, rest, compliance=alpha, damping=damping, break_at=strength)
        self.gravity = tv.Gravity(np.zeros(self.dim))
        start = tv.Particles(self.x, velocity=self.v, mass=self.mass, pinned=pinned.ravel())
        self.world = unprojected(world(start, [self.gravity, self.feature], substeps=1, precision="f64"))

    def again(self, substeps: int = 1, iterations: int = 1) -> None:
        """Put everything back to the start."""
        self.world.velocity, self.world.position = self.v, self.x
        self.world.substeps, self.world.iterations = substeps, iterations
        unprojected(self.world)

    def block(self, name: str, array=None) -> np.ndarray:
        """Return the rows of one block, of positions if `array` is None."""
        array = self.world.position if array is None else array
        return np.asarray(array)[self.corners[BLOCKS.index(name)]]

    def C(self, name: str) -> float:
        """Return the violation of a block, computed by the host."""
        return float(self.feature.violation(self.world.position)[BLOCKS.index(name)])

    @cached_property
    def gradient(self) -> np.ndarray:
        """Return grad C of the block "off" at the start, (arity, dim), by central differences of the host's formula."""
        out, step, c = np.zeros((self.arity, self.dim)), 1e-6, BLOCKS.index("off")
        for k in range(self.arity):
            for a in range(self.dim):
                pair = []
                for s in (1, -1):
                    x = self.x.copy()
                    x[self.corners[c, k], a] += s * step
                    pair.append(self.feature.violation(x)[c])
                out[k, a] = (pair[0] - pair[1]) / (2 * step)
        return out


def leave_nothing_behind(w: tv.World) -> None:
    """Check that a frame in which all positions are NaN leaves nothing behind; tests call this last.

    Undone, the state continues bit for bit, so a frame that is repeated with more substeps does not depend on it. Positions and
    velocities that are assigned instead make a start.
    """
    x, (memory, state) = w.position, (w._runner.memory, w._runner.scene.state)
    w.step(1e-3)
    kept, waiting = checkpoint.keep(w), checkpoint.flags(w)
    w.step(1e-3)
    after = w.hash()
    for mend in (lambda: checkpoint.undo(w, kept, waiting), lambda: (setattr(w, "velocity", 0 * x), setattr(w, "position", x))):
        for field in (state.x, state.d):
            memory.write(field, np.full_like(memory.read(field), np.nan))
        assert "non-finite" in w.step(1e-3).flags
        mend()
        report = w.step(1e-3)
        assert after in (w.hash(), "")
        after = ""
        assert all(np.isfinite(values).all() for values in memory.state().values())
        assert np.isfinite([report.energy, report.residual]).all()


def moments(m: np.ndarray, x: np.ndarray, d: np.ndarray) -> list[float]:
    """Return sum m d and sum m x x d."""
    turn = [m @ (x[:, a] * d[:, b] - x[:, b] * d[:, a]) for a in range(x.shape[1]) for b in range(a)]
    return [*(m @ d), *turn]


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_a_constraint_does_what_all_constraints_do(world, name):
    row = ROWS[name]
    scene = Scene(world, row)
    w, x0, dt = scene.world, scene.x, 1e-2

    # One pass from rest: no displacement where C = 0 or all corners are held; elsewhere -w grad C times C / sum w |grad C|^2.
    w.step(dt)
    move = w.position - x0
    assert np.abs(scene.block("met", move)).max() <= 1e-15 and (scene.block("stuck", move) == 0).all()
    inverse = 1 / MASS[: scene.arity, None]
    g = scene.gradient
    want = -inverse * g * row.off / (inverse * g**2).sum()
    np.testing.assert_allclose(scene.block("off", move), want, atol=1e-7 * np.abs(want).max())
    held = inverse * ((np.arange(scene.arity) > 0) | (scene.arity == 1))[:, None]
    want = -held * g * row.off / (held * g**2).sum()
    np.testing.assert_allclose(scene.block("held", move), want, atol=1e-7 * np.abs(want).max())
    assert scene.arity == 1 or (scene.block("held", move)[0] == 0).all()

    # More passes leave less of the violation, and residual reports what is left.
    left, scale = [abs(row.off)], abs(row.off)
    for iterations in (1, 2, 4, 8):
        scene.again(iterations=iterations)
        w.step(dt)
        left.append(abs(scene.C("off")))
        if name == "Bend 2D":
            size = scene.feature.quantity.unit or abs(scene.feature.rest[1])
            assert scene.feature.residual[1] * size == pytest.approx(left[-1], rel=1e-6, abs=1e-12)
    assert (np.diff(left) <= 1e-15).all() and left[-1] <= 1e-3 * scale

    # Momentum and angular momentum, sum m x_(n-1) x x_n, of the free blocks; covariance under rotations and translations.
    scene.again(iterations=3)
    history, seen = [], []
    for _ in range(20):
        w.step(dt)
        s = w._runner.memory.state()
        now = [scene.block(b, a) for b in ("free", "swing") for a in (s["position"], s["displacement"])]
        m = MASS[: scene.arity, None]
        history.append([])
        for x, d in (now[:2], now[2:]):
            history[-1] += moments(m[:, 0], x, d)
        seen.append([moments(m[:, 0], scene.block(b), scene.block(b, w.velocity) * dt) for b in ("free", "swing")])
        np.testing.assert_allclose(scene.block("turned"), scene.block("off") @ scene.turn.T + 0.5 * row.internal, atol=1e-11)
    if row.internal:
        assert np.ptp(history, axis=0).max() <= 1e-14 * 20
        np.testing.assert_allclose(np.reshape(seen, np.shape(history)), history, atol=1e-14)  # those of velocities, too
    assert np.isfinite(w.position).all() and (scene.block("stuck") == scene.block("stuck", x0)).all()

    # Rigid and soft constraints converge with h^2 alike.
    if row.bilateral:
        ends = []
        for substeps in (10, 20, 40, 80):
            scene.again(substeps, 8)
            w.run(0.3, dt=0.1)
            ends.append([scene.block("free"), scene.block("swing")])
        for k in range(2):
            steps = [rms(a[k], b[k]) for a, b in zip(ends[1:], ends[:-1], strict=True)]
            assert 1.9 <= order(steps) <= 2.1, (name, k, steps)

    # One of two equal springs is too weak for its load, and breaks before the first frame ends.
    f, c = scene.feature, BLOCKS.index("loaded")
    assert np.flatnonzero(f.broken).tolist() == [c + 1] and f.load[c + 1] == 0

    # Under a load F along grad_k f the spring gives way by alpha F / |grad_k f|: there it is in balance, and reports F.
    last = scene.gradient[-1]
    force = (row.off / 10) / scene.compliance[c] * last  # F = (C / alpha) grad_k f
    scene.again(20, 4)
    scene.gravity.g = force / MASS[scene.arity - 1]
    w.run(0.5, dt=0.1)
    np.testing.assert_allclose(scene.block("loaded"), scene.block("loaded", x0), atol=2e-7)
    np.testing.assert_allclose(scene.block("loaded", w.velocity), 0.0, atol=1e-8)  # velocities count the spring as a force, too
    assert f.load[c] == pytest.approx(row.off / 10 / scene.compliance[c], rel=1e-5)
    scene.again()
    leave_nothing_behind(w)


@pytest.mark.parametrize("name", ["Bend 2D", "Bend 3D", "AngleLimit 3D", "Dihedral 3D", "Area 3D", "Volume 3D"])
def test_gradients_of_many_are_those_of_each(name):
    # The host differentiates by as many coordinates at once as memory has room for: here by all, and by few. Sum grad = 0, and a
    # displacement of 1e-4 changes C by grad C dx to second order.
    points, make = ROWS[name].points, ROWS[name].make
    found, move = [], 1e-4 * np.random.default_rng(0).normal(size=points.shape)
    for count in (1, 2000):
        x = np.tile(points, (count, 1))
        feature = make(np.arange(len(x)).reshape(count, -1), np.zeros(count))
        feature.prepare(tv.Particles(x), np.ones(len(x)))
        found.append(feature.gradients(x))
        change = feature.violation(x + np.tile(move, (count, 1))) - feature.violation(x)
        np.testing.assert_allclose(change, (found[-1] * move).sum(axis=(1, 2)), atol=3e-7)
    np.testing.assert_array_equal(found[1], np.repeat(found[0], 2000, axis=0))
    assert np.abs(found[0].sum(axis=1)).max() < 1e-8 < 0.1 < np.abs(found[0]).max()


def test_cells_and_planets_move_as_what_lies_on_a_table(world):
    # Lengths times 2^a, masses times 2^b and accelerations times 2^a give the same bits times 2^a, down to cells of 8 um and
    # 1e-12 kg in f32. There w |grad f|^2 of an angle is 1e22, and a multiplier of a spring 1e-23 kg m, whose squares f32 cannot
    # hold.
    x, found = np.concatenate([PATH, PATH + 2.0]), []
    for length, mass in ((1.0, 1.0), (2.0**-17, 2.0**-40), (2.0**15, 2.0**80)):
        features = [tv.Bend([[0, 1, 2], [3, 4, 5]]), tv.Distance([[0, 1], [4, 5]]), tv.Pin([0, 4], compliance=1e-2 / mass)]
        start = tv.Particles(x * length, velocity=length * np.sin(np.arange(18)).reshape(6, 3), mass=mass)
        w = world(start, [tv.Gravity(9.81 * length), *features], substeps=10, solver=tv.Jacobi())
        reports = [w.step(1 / 60) for _ in range(10)]
        assert all(report.clean for report in reports)
        energies = [[report.residual, report.energy / (mass * length**2)] for report in reports]
        found.append(np.concatenate([w.position / length, np.reshape(energies, (-1, 1)) + np.zeros(3)]))
    assert np.array_equal(found[0], found[1]) and np.array_equal(found[0], found[2])


def test_the_tables_hold_every_constraint():
    named = {name.split()[0].rstrip(",") for name in (*ROWS, *OTHERS)}
    assert named == set(constraints.__all__) and all(reason for *_, reason in OTHERS.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Bend 3D", *(name for name in OTHERS if name not in ("Motor of quads", "Path, driven"))])
def test_a_batch_is_its_constraints_and_a_clone_is_its_world(world, name):
    # Two constraints in one batch, the second one of a Row soft. Then each alone, among the particles of both: in a batch of its
    # own where the code of batches differs (see Row.like), else in a world of its own, which reuses the kernels of the first.
    # Then a clone of the first world in the middle of its run. All have the same bits, loads and hashes.
    assert {row.like for row in ROWS.values()} == {*IN_BATCHES}
    points, make = (ROWS[name].points, ROWS[name].make) if name in ROWS else OTHERS[name][:2]
    corners = np.arange(2 * len(points)).reshape(2, -1)
    options = {"compliance": np.array([0, 1e-2]), "damping": np.array([0, 1.0]), "break_at": 1e9} if name in ROWS else {}

    def some(k):
        if name not in ROWS:
            return make(corners[k])
        return make(corners[k], 0.3, **{key: v if np.isscalar(v) else v[k] for key, v in options.items()})

    speed = np.random.default_rng(3).normal(size=(corners.size, points.shape[1]))
    start = tv.Particles(np.concatenate([points, points]), velocity=speed, mass=1 + np.arange(corners.size) % 3)
    whole = world(start, [some([0, 1])], substeps=5, iterations=2)
    sets = [[[0], [1]]] if name in IN_BATCHES else [[[0]], [[1]]]
    parts = [world(start, [some(k) for k in batches], substeps=5, iterations=2) for batches in sets]
    for w in (whole, *parts):
        w.run(0.1)
    for part, batches in zip(parts, sets, strict=True):
        np.testing.assert_array_equal(whole.position[corners[batches]], part.position[corners[batches]])
    (f,) = whole.features
    if not f.is_kinematic:
        np.testing.assert_array_equal(f.load, np.concatenate([g.load for part in parts for g in part.features]))
    twin = whole.clone()
    assert twin.hash() == whole.hash()
    if not f.is_kinematic:
        np.testing.assert_array_equal(twin.features[0].load, f.load)  # loads of a substep that the clone has not made
    for w in (whole, twin):
        w.run(0.1)
    assert twin.hash() == whole.hash()
    twin.close()
    leave_nothing_behind(whole)


def degenerate(row: Row) -> np.ndarray:
    """Return corners in every special position, (blocks, arity, dim)."""
    k, dim = row.points.shape
    line = np.arange(k)[:, None] * np.eye(dim)[0]
    pair = row.points.copy()
    pair[-1] = pair[0]
    last = row.points.copy()
    last[k // 2] = last[-1]
    folded = line.copy()
    folded[-1] = line[0] + 0.3 * np.eye(dim)[0]
    flat = row.points.copy()
    flat[:, -1] = 0
    cases = [0 * line, 0 * line + 7.3, line, -line, folded, pair, last, flat, row.points + 1e6, row.points - 1e12]
    return np.stack(cases + [row.points * s for s in (1e-30, 1e-20, 1e-13, 1e-11, 1e-6, 1e6, 1e14) if s < row.largest])


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in ROWS if name[:4] not in ("Rope", "Spac")])  # which are as Distance
def test_nothing_explodes_where_a_constraint_has_no_direction(world, name):
    # Rows 15, 17, 54, 56: no NaN, and no particle moves further than its corners are apart, or than the constraint demands.
    row = ROWS[name]
    k, dim = row.points.shape
    x = np.concatenate([degenerate(row)] * 2)
    m = len(x)
    corners = np.arange(m * k).reshape(m, k)
    probe = row.make(corners[:1], np.zeros(1))
    probe.prepare(tv.Particles(row.points), np.ones(k))
    rest = float(probe.violation(row.points)[0]) - row.off
    alpha = np.repeat([0.0, 1e-3], m // 2)
    feature = row.make(corners, np.full(m, rest), compliance=alpha, damping=np.where(alpha > 0, 1e-3, 0))
    w = world(tv.Particles(x.reshape(-1, dim)), [feature], substeps=1, iterations=3)
    for frame in range(20):
        report = w.step(1 / 60)
        assert "non-finite" not in report.flags and np.isfinite(report.residual) and np.isfinite(feature.load).all()
        if frame == 0:  # later, particles that a violent correction has set in motion fly on
            size = (0 if row.internal else np.abs(x).max(axis=(1, 2))) + (0 if feature.quantity.unit else abs(rest))
            size += np.ptp(x, axis=1).max(axis=1) + 1e-6 * np.abs(x).max(axis=(1, 2))
            moved = np.abs(w.position.reshape(x.shape) - x).max(axis=(1, 2))
            assert (moved <= 5 * size).all(), (np.argmax(moved / (size + 1e-300)), np.c_[moved, size])


FLAT = WINGS[[0, 3, 1, 2], :2]
SPRUNG = ("Distance 3D", "Rope 2D", "AngleLimit 3D", "Dihedral 3D", "Area of loops 2D", "Constraint 3D")  # one of each kind
SOFT = {  # constraints that may be soft, and are no row of ROWS; a Snap is as a Pin, Motor and Winch are as Bend and Rope
    "Pin": (FLAT[:1], lambda c, x, **soft: tv.Pin(c[:, 0], x[:, 0], **soft)),
    "Path": (
        FLAT[:1], lambda c, x, **soft: tv.Path(c[:, 0], [x[0, 0] - (9, 0), x[0, 0] + (9, 0)], smooth=False, **soft)
    ),
    "ShapeMatch 3D": (WINGS, lambda c, x, **soft: tv.ShapeMatch(c, x.reshape(-1, 3), **soft)),
    "Volume of surfaces": (WINGS, lambda c, x, **soft: tv.Volume(np.concatenate([row[TETRA] for row in c]), **soft)),
}  # fmt: skip
STIFF = np.array([0.02, 0.05, 0.1, 0.2, 0.32, 0.5, 0.8, 1.3, 2.0, 5.0, 20.0])  # omega h, about, at 20 substeps


def springs(name: str) -> tuple[tv.Particles, list]:
    """Return particles and features: moving blocks of one constraint each, as stiff as STIFF.

    Two more blocks at rest, one rigid and one damped, have rows of ROWS use the kernels of their Scene.
    """
    points = ROWS[name].points if name in ROWS else SOFT[name][0]
    blocks, (k, dim) = len(STIFF) + 2 * (name in ROWS), points.shape
    corners, x = np.arange(blocks * k).reshape(blocks, k), np.tile(points, (blocks, 1, 1))
    v = np.tile(0.02 * np.random.default_rng(5).normal(size=points.shape), (blocks, 1, 1))
    v[len(STIFF) :] = 0
    if name in ROWS:
        probe = ROWS[name].make(corners, np.zeros(blocks))
        probe.prepare(tv.Particles(x.reshape(-1, dim)), np.ones(blocks * k))
        slopes, rest = probe.gradients(x.reshape(-1, dim)), probe.violation(x.reshape(-1, dim))
        size = (slopes**2).reshape(blocks, -1).sum(axis=1)
        if ROWS[name].bilateral:  # one-sided constraints just touch
            rest[: len(STIFF)] -= 0.1 * ROWS[name].off
        alpha = np.append(size[: len(STIFF)] / (1200 * STIFF) ** 2, [0.0, 1e-2])
        damping = np.append(np.zeros(len(STIFF) + 1), 3.0)
        made = ROWS[name].make(corners, rest, compliance=alpha, damping=damping, break_at=1e9)
    else:
        made = SOFT[name][1](corners, x, compliance=1 / (1200 * STIFF) ** 2)
    start = tv.Particles(x.reshape(-1, dim), velocity=v.reshape(-1, dim), mass=np.tile(MASS[:k], blocks))
    return start, [tv.Gravity(np.zeros(dim)), made]


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SPRUNG, *SOFT])
def test_starts_from_velocities_that_were_read_change_nothing(world, name):
    # Without gravity a block has the energy of its start. Starts from the velocities that are read, after each frame, may neither
    # pump a spring nor brake it by more than 1 - (1 - (omega h)^4 / 16). With the force of the substep before in them, they would
    # grow by 1 + (omega h)^2 / 4 per frame, e^(15 omega^2 h^2) per second. Assigning what was read makes no start.
    start, features = springs(name)
    size = len(ROWS[name].points if name in ROWS else SOFT[name][0])  # particles of a block
    w = world(start, features, precision="f64")

    def kinetic(back):
        w.position, w.velocity = start.position, start.velocity
        out = []
        for _ in range(frames):
            if back:
                w._start_from(w.velocity)
            w.step(1 / 60)
            each = (start.mass * (w.velocity**2).sum(axis=1)).reshape(-1, size).sum(axis=1)
            out.append(each[: len(STIFF)])
        return np.array(out)

    for substeps, frames in (2, 150), (8, 100), (20, 150), (80, 60):
        w.substeps = substeps
        alone, back = kinetic(False), kinetic(True)
        few = frames // 5
        most, first, last = alone.max(axis=0), back[:few].max(axis=0), back[-few:].max(axis=0)
        assert (last <= 1.02 * np.maximum(first, most)).all(), (name, substeps, last / np.maximum(first, most))
        resolved = STIFF * 20 / substeps < 0.3
        assert (last >= 0.9 * alone[-few:].max(axis=0))[resolved].all(), (name, substeps, last / alone[-few:].max(axis=0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dim", "solver", "settings"),
    [
        (2, tv.ConjugateGradient(), (1, 1)),
        (3, tv.Direct(), (100, 1)),
    ],
    ids=["2D, ConjugateGradient", "3D, Direct"],
)
def test_no_bad_start_flies(world, monkeypatch, dim, solver, settings):
    # Rigid constraints that nothing in the scene pulled apart have no energy to give, at any number of substeps. The violation
    # that is left before the first substep is removed at a third of its size per frame: 2 sizes in 6 frames, after the 2 that it
    # takes to meet the constraints. Passes alone would move bodies by their size in a substep: 600 sizes at 100 substeps.
    # In space: what is not in the plane, and rods.
    monkeypatch.setitem(bad_starts.BODIES, 3, bad_starts.SOLID | {"rods": bad_starts.BOTH["rods"]})
    bad, (substeps, passes) = bad_starts.BadStart(dim), settings
    start = tv.Particles(bad.position, pinned=bad.pinned, mass=0.1)
    w = world(start, bad.features, precision="f64", solver=solver, substeps=substeps, iterations=passes)
    for frame in range(6):
        report = w.step(1 / 60)
        assert (bad.far(w.position) < 4).all() and ("moved" in report.flags) == (frame == 0)
    assert "unconverged" in report.flags  # some constraints contradict each other
    leave_nothing_behind(w)
