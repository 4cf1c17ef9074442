"""Building a world: which parts of its scene exist on the device, and in which order they are made."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from ..colliders.body_impacts import BodyImpacts, can_have_impacts, stops_bodies
from ..colliders.collider import Collider
from ..colliders.wall_group import grouped
from ..constraints.core.anchored import refuse_held_twice
from ..contact.pair_contact import PairContact
from ..device import runtime, ti
from ..device.copies import Copies
from ..device.memory import Memory
from ..device.patches.compiler import BRIEF, FEW, LEAN, UNSEARCHED
from ..device.thread_team import PIECES, Team, size_of
from ..features.feature import Acceleration, Batch, Feature, Scene
from ..neighbours.neighbour_search import NeighbourSearch
from ..neighbours.periodic import Periodic
from ..particles import Particles, Radii, State
from ..particles.spin import Spin
from ..solvers.choice import choose_solver
from ..solvers.direct import Direct
from ..solvers.slots import Slots
from ..solvers.solver import Solver
from . import high_order
from .diagnostics import Diagnostics
from .frames import Frames
from .integrator import Forces, Verlet
from .scale import Scale
from .sleep import Sleep, SleepPass
from .step import Step

T = TypeVar("T", bound=Feature)
PRECISIONS = {"f32": ti.f32, "f32-compensated": ti.f32, "f64": ti.f64}
PATHS = ("auto", "fused", "parallel")
# Initial room of a neighbour list, in near pairs per particle, in 2D and 3D, by whether all radii are equal. Within 1.25
# diameters equal discs have fewer than 6 neighbours on average: lines between these do not cross, which makes a planar graph.
ROOM = {True: (6.5, 14), False: (12, 32)}
# Particles and constraints from which a team of threads pays. Times of a frame on one thread and on two: 8 substeps of a falling
# pile, 0.122 and 0.136 ms with 500 discs, 0.169 and 0.170 with 1000, 0.50 and 0.37 with 4000; 20 substeps of cloth with 225
# particles (1200 with constraints) 0.55 and 0.35; of ropes with 205 (405) 0.18 and 0.18, with 820 (1620) 0.64 and 0.40.
CROSSOVER = 1000
# Code sizes, in multiples of a Distance in 2D, from which kernels are long, or endless. A hundred figures on stairs (13) compile
# in 13 to 17 s with Taichi's simplifier and in 5 s without, and frames take as long. A pile of 1000 (3.6) takes 5.3 to 7 s, and
# 3.5 to 4.5 s without the search for equal expressions; frames of 6 ms then take 2 to 8 % longer, those of 4000 a fifth.
LONG, ENDLESS = 3.5, 10.0
USUAL = 20  # substeps of a frame in scenes with constraints, or forces that change
GRAINS = 4  # where contacts are rows, and particles and rigid bodies fall freely between them, which is exact, or nearly
MANY = 4 * FEW  # particles from which frames take so long that the search pays for long kernels
# From so many copies of a small world on, its kernels are simplified if they are smaller than MIDDLING, since they run so often.
# Frames of a double pendulum (1.3) take 8 to 13 % less, of 100 discs (3.6) 5 to 17 %, of discs, ropes and soft balls (6) 5 %;
# compiling takes 0.6 s, 0.7 to 1.4 s, and 7 to 14 s more.
COPIES, MIDDLING = 100, 5.0


@dataclass
class Assembly:
    """The parts of a world on the device."""

    scale: Scale
    path: str
    solver: Solver
    memory: Memory
    scene: Scene
    batches: list[Batch]
    search: NeighbourSearch | None
    step: Step
    diagnostics: Diagnostics
    frames: Frames | None  # for worlds with copies


def assemble(
    particles: Particles, features: tuple[Feature, ...], starts: Sequence[Particles | None], first: int,
    solver: Solver | None, precision: str, path: str, order: int, scale: Scale | None = None, copies: Copies | None = None,
) -> Assembly:  # fmt: skip
    """Check the features against the particles and each other, then declare and place every field, in one tree.

    particles: as they are now. starts: for each feature, the particles when it was added; None if it is added now. first: number
    from which on particles are added now. solver: None to choose one by structure. scale: of the world that this one replaces.
    copies: set if there will be many copies of the world.
    """
    inv_mass = particles.inv_mass.copy()
    box = next((f for f in features if isinstance(f, Periodic)), None)
    for feature, start in zip(features, starts, strict=True):
        feature.periodic = box
        feature.start = particles if start is None else start
        feature.prepare(feature.start, inv_mass)
    refuse_held_twice(particles, features)
    if box:
        from .misfits import refuse_misfits  # noqa: PLC0415  (it imports features that the scene may not have)

        refuse_misfits(box, particles, features)
    if any(isinstance(f, Sleep) for f in features):
        from .misfits import refuse_restless  # noqa: PLC0415

        refuse_restless(features, order)
    for feature, start in zip(features, starts, strict=True):
        if isinstance(feature, PairContact):
            feature.ties = [f for f in features if isinstance(f, Batch)]
            feature.walls = [f for f in features if isinstance(f, Collider)]
        if start is None:
            feature.review(particles, inv_mass)
        else:
            feature.check_added(particles, first)
    if particles.spins and order > 2:
        raise ValueError(
            f"World: order = {order}, but particles that spin are for order 2: only contacts and walls turn them. Leave out spin."
        )
    runtime.ensure_started()
    check_architecture(precision, features)
    now = Scale(len(particles), len(particles) + sum(f.count for f in features if isinstance(f, Batch)))
    scale = scale if scale and scale.holds(now) else now
    path = _chosen(path, scale) if order == 2 and not copies else "fused"
    few = scale.particles < FEW
    memory = Memory(PRECISIONS[precision], few, _passes(particles, features, scale, copies), copies=copies)
    try:
        state = State(memory, particles, inv_mass, precision == "f32-compensated")
        if particles.spins:
            state.spin, state.spins = Spin(memory, particles, inv_mass, state.number), True
        return _bind(Scene(memory, state, particles, inv_mass, order=order), features, solver, path, scale)
    except BaseException:
        memory.destroy()
        for feature in features:
            feature.scene = None
        raise


def _passes(particles: Particles, features: tuple[Feature, ...], scale: Scale, copies: Copies | None) -> Mapping[str, Any]:
    """Return the settings by which kernels skip passes of Taichi's compiler, from the size of their code.

    Walls share code by group, other features by kind.
    """
    code = {(f.code_key or f) if isinstance(f, Collider) else type(f): f.code_size for f in features}
    code_size = sum(code.values()) * (1.5 if particles.dim == 3 else 1.0)
    often = copies is not None and copies.count >= COPIES and code_size < MIDDLING
    if code_size > ENDLESS or (scale.particles < FEW and not often):
        return BRIEF
    return UNSEARCHED if code_size > LONG and scale.particles < MANY else LEAN


def _bind(scene: Scene, features: tuple[Feature, ...], solver: Solver | None, path: str, scale: Scale) -> Assembly:
    memory, state, particles = scene.memory, scene.state, scene.particles

    def of(kind: type[T]) -> list[T]:
        """Return the features of one kind."""
        return [f for f in features if isinstance(f, kind)]

    for first in [*of(Periodic), *of(Sleep)]:
        first.bind(scene)
    accelerations, walls = of(Acceleration), of(Collider)
    drivers = [f for f in of(Batch) if f.is_kinematic and f.count]
    batches = [f for f in of(Batch) if not f.is_kinematic and (scene.inv_mass[f.indices] > 0).any()]
    contact = next((c for c in of(PairContact) if c.can_touch), None)
    if contact or walls:
        scene.radius = Radii(memory, particles.radius, scene.count)
    rows = bool(contact)
    scene.walls = grouped(walls)
    surfaces = [*walls, *([contact] if contact else [])]
    has_friction, bounces = any(f.has_friction for f in surfaces), any(f.has_restitution for f in surfaces)
    scene.bounces = bounces and bool(walls)
    solver = solver or (choose_solver(batches, scene, rows) if scene.order == 2 else Direct())
    if batches:
        with memory.owned("slots"):
            scene.slots = Slots(scene, batches, solver, rows)
        # Rounding errors are carried along where they are all that constraints leave, where rest values move by themselves, whose
        # steady loads would otherwise tremble by m ulp(x) / h^2, and where clusters lie on something: they would sway and creep.
        lies = bool(contact or walls) and any(b.clusters for b in batches)
        carries = sums_exactly() and (scene.slots.exact or lies or any(b.driven for b in batches))
        if not state.double and (state.compensated or carries):
            state.carry(memory, particles, lies)
        if scene.order > 2:
            high_order.check_solved(batches, scene, solver)
    size = size_of(path, scale.work)
    team = Team(memory, size, len(particles), path == "parallel" and size == 1, pieces=PIECES if contact else size)
    if contact:
        contact.enter(scene)
    if can_have_impacts(scene, batches) and not rows:
        if any(w.has_restitution for w in walls) or (walls and stops_bodies(scene, batches)):
            scene.impacts = BodyImpacts(scene, batches, any(w.has_friction for w in walls))
    search = contact.make_search(scene, batches, team) if contact else None
    state.remember(
        memory,
        has_friction or rows or any(w.needs_start_position for w in walls) or scene.bounces,
        bounces or bool(scene.impacts) or rows,
        bounces,
    )
    for feature in of(Batch):
        feature.scene = scene  # also for those that do nothing, because all of their particles are held
    for feature in [*accelerations, *drivers, *batches]:
        with memory.owned(feature):
            feature.bind(scene)
    for group in scene.walls:
        group.bind(scene)
    searches = [(f.make_search(scene, team), f.neighbours_per_particle) for f in accelerations if f.pairwise]
    for feature in features:
        feature.new_force = False  # the force has been on the device from the start
        feature.changed = feature in drivers  # they move to their targets in the first frame; other knobs are in fields already
        feature.note_built()
    forces = Forces(scene, accelerations)
    integrator = Verlet(scene, forces, bool(contact)) if scene.order == 2 else high_order.Composition(scene, forces, batches)
    step = Step(scene, integrator, batches, drivers, contact, search, walls, team)
    if state.sleepers:
        step.sleep = SleepPass(step, state.sleepers, drivers, batches)
    diagnostics = Diagnostics(step, solver)
    if search and contact:
        room = ROOM[bool((particles.radius == particles.radius[:1]).all())][particles.dim - 2]
        search.list.allocate(int(len(particles) * max(room, contact.neighbours_per_particle)) + 64)
    for each, room in searches:
        if each:
            each.list.allocate(len(particles) * room + 64)
    frames = Frames(step, memory) if memory.copies else None
    memory.place()
    return Assembly(scale, path, solver, memory, scene, batches, search, step, diagnostics, frames)


def checked_features(features: Iterable[Feature]) -> tuple[Feature, ...]:
    """Return the features of a new world, checked: each acts in no world and is listed once."""
    features = listed("World", features)
    for k, feature in enumerate(features):
        if not isinstance(feature, Feature):
            hint = f"; write {feature.__name__}(...)" if isinstance(feature, type) else ""
            raise TypeError(f"World: features[{k}] = {feature!r} is not a force, constraint or wall{hint}.")
        if feature.scene is not None:
            raise ValueError(
                f"World: features[{k}] = {feature!r} already acts in another world. Make a new one, or use feature.copy()."
            )
    if len({id(f) for f in features}) < len(features):
        raise ValueError("World: the same feature is listed twice.")
    refuse_several("World", features)
    return features


def refuse_several(who: str, features: tuple[Feature, ...]) -> None:
    """Raise ValueError for kinds of features of which a world has one at most."""
    if sum(isinstance(f, PairContact) for f in features) > 1:
        raise ValueError(f"{who}: more than one Contact; one covers all particles.")
    if sum(isinstance(f, Periodic) for f in features) > 1:
        raise ValueError(f"{who}: more than one Periodic; give one box, with all of its axes.")
    if sum(isinstance(f, Sleep) for f in features) > 1:
        raise ValueError(f"{who}: more than one Sleep; one is for all particles.")


def usual_substeps(features: tuple[Feature, ...]) -> int:
    """Return how many substeps frames have where the user does not say."""
    rows = any(isinstance(f, PairContact) for f in features)
    bodies = _are_separate_bodies([f for f in features if isinstance(f, Batch) and not f.is_kinematic])
    forces = [f for f in features if isinstance(f, Acceleration) and not f.is_tool]
    free = all((f.common and f.steady) or not f.accelerates for f in forces)
    return GRAINS if rows and free and bodies else USUAL


def _are_separate_bodies(batches: list[Any]) -> bool:
    """Whether all of these constraints are rigid clusters, each of particles of its own."""
    if not all(b.clusters and not (b.soft or b.breaks) for b in batches):
        return False
    return not batches or bool((np.bincount(np.concatenate([b.members.indices for b in batches])) <= 1).all())


def listed(who: str, features: Any) -> tuple[Feature, ...]:
    """Return features as a tuple, checked."""
    if isinstance(features, Feature) or not isinstance(features, Iterable):
        raise TypeError(f"{who}: features = {features!r} is a {type(features).__name__}; write a list, [...].")
    return tuple(features)


def checked_solver(solver: Solver | None) -> Solver | None:
    """Return the solver of a new world, checked; None if it is to be chosen."""
    if solver is not None and not isinstance(solver, Solver):
        hint = f"; write {solver.__name__}()" if isinstance(solver, type) else ""
        raise TypeError(f"World: solver = {solver!r} is not a solver, as tv.Jacobi() or tv.Direct() is{hint}.")
    return solver


def check_settings(precision: str, path: str, order: int, features: tuple[Feature, ...]) -> None:
    """Raise ValueError for unknown settings, and for an order that the features do not support."""
    if precision not in PRECISIONS:
        raise ValueError(f"World: precision = {precision!r}, but it must be one of {', '.join(map(repr, PRECISIONS))}.")
    if path not in PATHS:
        raise ValueError(f"World: path = {path!r}, but it must be one of {', '.join(map(repr, PATHS))}.")
    if order not in high_order.ORDERS:
        raise ValueError(f"World: order = {order!r}, but it must be one of {', '.join(map(str, high_order.ORDERS))}.")
    if order > 2:
        high_order.refuse(order, features, precision, path)


def sums_exactly() -> bool:
    """Whether (a + b) - a is compiled exactly. On some architectures Taichi does not mark it so, and drivers simplify it to b."""
    return runtime.architecture() in runtime.LLVM and not runtime.fast_math()


def check_architecture(precision: str, features: tuple[Feature, ...]) -> None:
    """Raise ValueError for what the running Taichi cannot compile, or not correctly."""
    arch = runtime.architecture()
    if precision == "f32-compensated" and runtime.fast_math():
        raise ValueError(
            'World: precision = "f32-compensated" needs exact rounding, but Taichi was started with fast_math=True. '
            "Use tv.init(), or ti.init(fast_math=False)."
        )
    if arch in runtime.LLVM:
        return
    if precision == "f32-compensated":  # Taichi does not mark sums as exact there, and drivers replace (a + b) - a by b
        raise ValueError(
            f'World: precision = "f32-compensated" needs exact rounding, which Taichi does not have on {arch}. '
            'Use "f64", or tv.init(arch="cpu").'
        )
    for feature in features:
        if precision == "f64" and isinstance(feature, Batch) and feature.transcends:
            raise ValueError(
                f"World: {feature!r} takes an angle, a cube root or an exponential, which {arch} has for f32 only, but "
                'precision = "f64". Use "f32", or tv.init(arch="cpu").'
            )


def _chosen(path: str, scale: Scale) -> str:
    """Return the path; for "auto", one CPU thread while a team would cost more than it saves."""
    if path != "auto":
        return path
    if runtime.architecture() != "cpu":
        return "parallel"
    return "fused" if scale.work < CROSSOVER or runtime.cores() == 1 else "parallel"
