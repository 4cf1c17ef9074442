"""The text of world.explain(): the parts of a world."""

from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from ..colliders.box import Box
from ..colliders.collider import Collider
from ..colliders.half_space import HalfSpace
from ..device import runtime
from ..device.patches import enabled
from ..features.feature import Acceleration, Batch
from ..forces import Gravity
from ..neighbours.neighbour_search import NeighbourSearch
from ..neighbours.periodic import Periodic
from ..shapes.shape import morton
from ..solvers.choice import explain_choice
from .build import GRAINS
from .energy_bound import springs
from .sleep import Sleep

if TYPE_CHECKING:
    from ..world import World


MANY = 10_000  # particles from which their order in memory matters
PERIOD = 16  # substeps in a period of a spring that see cos(pi / 16) = 0.98 of the peak of a blow
FLAT = 1e-6  # 1 - cos(slope), up to which a floor is level: a twelfth of a degree


def _default(world: "World") -> str:
    """Return why there are so many substeps, if the user has not said how many."""
    if world._controller.auto or world._substeps:
        return ""
    few = world._usual_substeps == GRAINS
    return f" (by default, for {'contacts between free falls' if few else 'constraints, or forces that change'})"


def explain(world: "World") -> str:
    """Return a text of a few lines about particles, features, parts that were left out, launches and memory."""
    p, step = world.particles, world._runner.step
    lines = [
        f"{len(p)} particles in {p.dim}D, {int((p.inv_mass == 0).sum())} static; {world.precision} on "
        f"{runtime.architecture()}, {runtime.threads()} threads",
        f"{'auto, now ' * world._controller.auto}{world.substeps} substeps x {world.iterations} iterations{_default(world)}, "
        f"path {world.path}: {_launches(world)}"
        + (f"; order {world.order}, {step.integrator.stages} stages in a substep" * (world.order > 2)),
        "In the kernels:",
        *(f"    {line}" for line in _present(world)),
        "Left out, at no cost:",
        *(f"    {line}" for line in _absent(world)),
    ]
    total = sum(world.fields.values())
    spare = sum(memory.spare_bytes for memory in world._runner.memories)
    room = f"; {spare} bytes more stay for what went" if spare else ""
    lines.append(f"Memory: {len(world.fields)} fields, {total} bytes, {total / max(1, len(p)):.0f} per particle{room}")
    for owner, own in groupby(sorted(world.fields, key=_owner), key=_owner):
        names = list(own)
        size = sum(world.fields[name] for name in names)
        lines.append(f"    {owner:10s} {size:>9d} bytes: {', '.join(n.partition('.')[2] or n for n in names)}")
    if step.batches:
        why = "" if world._requested[0] else f"; chosen because {explain_choice(world._runner.solver)}"
        lines.append(f"Solved by {world._runner.solver.explain(step.batches, step.slots)}{why}")
        lines.append(f"Constraint corners that can move: {step.slots.total} of {sum(b.indices.size for b in step.batches)}")
    if _scattered(p.position):
        lines.append(
            "Numbered at random: neighbours are far apart in memory. tv.shapes.Shape(position).in_order() numbers them in turn; "
            "large worlds then take half of the time."
        )
    return "\n".join(lines)


def compiling(world: "World") -> list[str]:
    """Return lines with the compile times; none where Taichi is not the version that device/patches supports."""
    times = world._runner.memory.compiler.times
    if not times.kernels:
        return ["Nothing was compiled for it, or not yet."] if "sharing" in enabled else []
    total = sum(times.kernels.values())
    rest = {"motion and the rest": total - sum(times.features.values())}
    lines = [f"Compiled in {total:.2f} s: {', '.join(f'{name} {t:.2f}' for name, t in times.kernels.items())}"]
    parts = sorted((times.features | rest).items(), key=lambda part: -part[1])
    return [*lines, f"    of which about {', '.join(f'{t:.2f} for {name}' for name, t in parts)}"]


def _scattered(position: np.ndarray) -> bool:
    """Whether the numbers of neighbours in space differ by more than a tenth of n, in the median over a sample."""
    if len(position) < MANY:
        return False
    number = np.arange(0, len(position), -(-len(position) // MANY))
    return bool(np.median(np.abs(np.diff(number[np.argsort(morton(position[number]))]))) > len(position) / 10)


def _owner(field: str) -> str:
    return field.partition(".")[0] if "." in field else "particles"


def _launches(world: "World") -> str:
    step = world._runner.step
    if not step.launched:
        return "1 launch per frame" + f", of {step.team.size} threads" * (step.team.size > 1)
    solved = world.iterations * (step.constraints.steps + 1) if step.constraints.steps else 0
    each = (world.iterations * step.halves if step.particles.acts else 1) + solved
    waits = "one"
    if step.has_impacts:  # after each substep the host reads whether linked particles struck anything
        each, waits = each + step.finishes, str(world.substeps + 1)
    if step.contact_pass.rows:
        each += world._runner.launcher.passes_launched + 2
    more = ", and those behind a stale list again, once it was built" if step.searches else ""
    total = world.substeps * each + 1 + bool(step.searches)
    return f"{total} launches per frame, of which the host waits for {waits}{more}"


def _present(world: "World") -> list[str]:
    out = []
    for f in world.features:
        if isinstance(f, Batch):
            idle = int(f.immovable(world._runner.scene.inv_mass).sum()) if f.count and not f.is_kinematic else 0
            note = f", {idle} of them between particles that cannot move" if idle else ""
            out.append(f"{f!r}: {f.count} {'driven particles' if f.is_kinematic else 'constraints'}{note}")
        elif isinstance(f, Acceleration) and f.pairwise:
            out.append(_pairs(f))
        elif isinstance(f, Acceleration):
            out.append(f"{f!r}: in the loop over particles")
        elif isinstance(f, Collider):
            out.append(f"{f!r}: in the loop over particles, last")
        elif isinstance(f, Periodic):
            lengths = " x ".join(f"{length:g}" if np.isfinite(length) else "open" for length in f.lengths)
            out.append(f"{f!r}: differences of nearest images, {lengths} m{', sheared' * f.sheared}")
        elif isinstance(f, Sleep):
            slow = f"slower than {f.speed:g} m/s for {f.time:g} s"
            out.append(f"{f!r}: leaves out islands that were {slow}; {world.last.asleep if world.last else 0} asleep")
        elif world._runner.search:
            out.append(f"{f!r}: {_listed(world._runner.search)}")
        else:
            out.append(f"{f!r}: nothing, since all radii are 0")
    if world.particles.spins:
        out.append("spin: with friction" + (", and orientations" if world._runner.step.orients else ""))
    out += [*_sliding(world), *_creeping(world), *_brittle(world)]
    return out or ["motion in a straight line"]


def _sliding(world: "World") -> list[str]:
    """Return a note on walls with friction and a slope, on which discs and spheres slide that one may expect to roll."""
    p = world.particles
    pull = sum((np.asarray(f.kernel_values()["g"]) for f in world.features if isinstance(f, Gravity)), np.zeros(p.dim))
    if p.spins or not p.radius.any() or not pull.any():
        return []
    rough = [repr(f) for f in world.features if isinstance(f, Collider) and np.any(f.friction) and not _is_level(f, pull)]
    return [f"{', '.join(rough)}: particles slide down a slope; with tv.Particles(spin=True) they roll"] if rough else []


def _creeping(world: "World") -> list[str]:
    """Return a note on walls with friction where no contacts are solved, on which what constraints hold creeps under loads."""
    rough = [repr(f) for f in world.features if isinstance(f, Collider) and np.any(f.friction)]
    if not rough or not world._runner.step.batches or world._runner.step.contact_pass.rows:
        return []
    return [f"{', '.join(rough)}: what constraints hold creeps under loads; beside tv.Contact(), with radii, friction holds it"]


def _brittle(world: "World") -> list[str]:
    """Return notes on springs that blows may break, and that substeps do not resolve."""
    out, h = [], world._clock.h or 1 / 60 / world.substeps
    for f, some in springs(world):
        if not f.breaks:
            continue
        some = some & np.isfinite(np.inf if f.break_at is None else f.break_at)
        omega = np.sqrt((f.weights(world.position)[some] / f.compliance[some]).max(initial=0.0))
        need = np.ceil(np.round(world.substeps * PERIOD * omega * h / (2 * np.pi), 6))
        if need > world.substeps:
            out.append(
                f"{f!r}: a blow counts with its mean over a substep, less than its peak; {need:.7g} substeps resolve it "
                f"(omega h = {omega * h:.3g})"
            )
    return out


def _is_level(wall: Collider, pull: np.ndarray) -> bool:
    """Whether a wall is a floor across the pull of gravity [m/s^2], or a box with one."""
    normals = wall.normal[None] if isinstance(wall, HalfSpace) else np.eye(len(pull)) if isinstance(wall, Box) else []
    return any(abs(n @ pull) >= (1 - FLAT) * np.linalg.norm(pull) for n in normals)


def _pairs(f: Acceleration) -> str:
    """Return how a pair force finds its pairs."""
    if not f.dev.search:
        return f"{f!r}: all pairs, before the loop over particles"
    return f"{f!r}: before the loop over particles; {_listed(f.dev.search)}"


def _listed(search: NeighbourSearch) -> str:
    """Return how near pairs are found."""
    sizes = ", ".join(f"{size:.3g}" for size in search.cells.sizes)
    return f"grid with cells of {sizes} m, neighbour list with a skin of {search.skin:.3g} m"


def _absent(world: "World") -> list[str]:
    step = world._runner.step
    rows = [
        (not step.search, "grid, neighbour list, contacts: no Contact between particles with radii"),
        (not step.batches, "slots and gathers: no constraint on particles that can move"),
        (not step.walls, "wall pass: no wall"),
        (not world.particles.spins and bool(step.walls or step.search), "spin: particles have none"),
        (not step.state.images, "nearest images: no Periodic"),
        (
            any(not r.in_turn for r in [step.contact_pass.rows] if r),
            "impacts one after the other: no restitution above 0.97, or links that are relaxed",
        ),
        (not step.sleepers, "islands and who sleeps: no Sleep"),
        (not step.integrator.forces.all, "accelerations: no force"),
        (not step.integrator.decays, "exponential drag: no Drag or Wind"),
        (not step.integrator.uses_velocity, "displacement by forces alone: no force reads velocities"),
        (
            not any(getattr(b, "soft", False) for b in step.batches),
            "compliance and its history: every constraint is rigid",
        ),
        (not step.breakers, "loads compared and breaks counted: no constraint has break_at"),
        (step.scene.radius is None, "radii: nothing touches"),
        (not step.state.sums, "low words: precision is not f32-compensated, and no chain is solved to rounding"),
    ]
    return [text for missing, text in rows if missing] or ["nothing"]
