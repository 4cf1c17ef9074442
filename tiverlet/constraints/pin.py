"""Particles held at targets."""

from typing import Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device import ti
from ..device.memory import ALL, rows_of
from ..features.arguments import shifted
from ..features.feature import Knob, Scene
from ..geometry.interpolation import interpolate
from ..particles import Particles, in_range
from .core.anchor_passes import AnchorPasses, Place
from .core.anchored import Anchored, one_each


def _targets(pin: "Pin", target):
    target = checks.plain("Pin", "target", target)
    if target.ndim == 3 and target.shape[1] == 1:  # as world.position[pin.indices]
        target = target[:, 0]
    if target.ndim == 1:  # one point for all
        target = target[None] if len(pin.members.rows) == 1 else target[None].repeat(pin.members.count, axis=0)
    target = checks.points("Pin", "target", target, dim=pin.dim, count=pin.members.count)
    in_range("Pin", "target", target)
    return target


def _indices(pin: "Pin", indices) -> np.ndarray:
    """Check assigned indices and replace `members` by them. Returns the indices, (m, 1)."""
    rows = np.array(indices)  # a copy, which its owner cannot change later
    rows = rows[:, 0] if rows.ndim == 2 and rows.shape[1] == 1 else rows  # (m, 1), the shape in which indices are read
    members, own = one_each("Pin", rows, checks.ANY if pin.start is None else pin.start.count), vars(pin)
    now, before = members.rows, pin.members.rows
    if len(now) != len(before):
        raise ValueError(f"Pin: indices has {len(now)} particles, but this Pin holds {len(before)}. Make another one.")
    if pin.scene is not None and not pin.needs_new_state:
        own.update(held=before, needs_new_state=now.tobytes() != before.tobytes())
    own["members"] = members
    return now


class Target(Place):
    """A target for each particle, which moves there during a frame. here: the initial targets, (m, dim)."""

    def __init__(self, scene: Scene, passes: AnchorPasses, here: np.ndarray):
        add, (m, dim) = scene.memory.field, here.shape
        self.name, self.state, self.corners = passes.name, scene.state, passes.corners
        self.source = add("Pin.from", m, width=dim, values=here, state=True)
        self.target = add("Pin.to", m, width=dim, values=here, state=True)
        self.in_state = {"source": self.source, "target": self.target}

    @ti.func
    def aim(self, c, frame_fraction):
        """Return the target at this fraction of the frame."""
        return interpolate(self.source[c], self.target[c], frame_fraction)

    @ti.func
    def drive(self, c, h, frame_fraction):
        """Put the particle on the target."""
        i = self.corners.member(c, 0)
        if ti.static(self.state.sums):  # else what hangs on it would be jerked, with rounding / h^2
            source, target = ti.cast(self.source[c], ti.f64), ti.cast(self.target[c], ti.f64)
            self.state.bring(i, source + (target - source) * frame_fraction)
        else:
            self.state.bring(i, self.aim(c, frame_fraction))

    @ti.func
    def offsets(self, c, frame_fraction, first, fresh):
        """Return x - target, now and at the start of the substep."""
        x = self.state.place(self.corners.member(c, 0))
        return x - self.aim(c, frame_fraction[1]), x - self.state.d[self.corners.member(c, 0)] - self.aim(c, frame_fraction[0])

    @ti.func
    def offset_now(self, c, back):
        """Return x - target at the end of the frame, where the target is at rest."""
        i = self.corners.member(c, 0)
        return self.state.place(i) - back * self.state.d[i] - self.target[c]


class Pin(Anchored):
    """Particles held at targets that may move: an anchor, a hand, a mouse.

    C(x) = x - target (a vector), with unit gradients.

    indices: (m,) particles, read as (m, 1), a row for each. target: (m, dim), (m, 1, dim) as world.position[pin.indices], or
    (dim,) [m]; None holds the particles at their initial positions. Both are live. Assign to .target between frames, and the
    particles go there in a straight line during the next frame. Assign as many other particles to .indices, and the Pin holds
    those from then on, as a new Pin would. That compiles nothing, and takes as long as with a tv.Hand.
    compliance: number or (m,) [m/N]. 0 takes the particles out of the solver and drives them, whatever forces act on them; above
    0 a spring of stiffness 1 / compliance draws them, as a mouse does. damping: [N s/m], of that spring.

    `load` is the force of each spring on its particle [N]. It raises where particles are driven, since nothing computes the force
    that holds them: give a small compliance.

    Within a frame the speed is constant, and changes where frames meet. So what hangs on a driven Pin of acceleration a bears all
    of the impulse m a dt of a frame in the first substep, with m a dt / h, where `break_at` compares it, and nothing in the last
    one, which `load` tells of. Where loads matter, step frames of one substep, with a target for each: they bear m a.
    """

    each = ("compliance", "damping", "target")
    dim = 0
    exclusive = True
    indices: Any = Knob(_indices, "The particles that are held, (m, 1).")
    held = np.zeros((0, 1), dtype=np.int32)  # the particles before others were assigned, if it needs_new_state for these
    target = Knob(_targets, "Where the particles are held, (m, dim) [m].", place=shifted)

    def __init__(self, indices, target=None, *, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0):
        self.setup(indices, compliance, damping)
        self._keep(indices=self.members.indices)
        if target is not None:
            self.target = target

    def _compliance(self, value) -> np.ndarray:
        value = super()._compliance(value)
        if (value > 0).any() and not (value > 0).all():
            i = int(np.argmin(value > 0))
            raise ValueError(f"Pin: compliance[{i}] = 0 among positive ones. Use two Pins, one driven and one drawn.")
        if "compliance" in vars(self) and (value > 0).any() != self.soft:
            now = "drawn by springs" if self.soft else "driven"
            raise ValueError(
                f"Pin: compliance cannot go {'to 0' if self.soft else 'from 0'}, because these particles are {now}. Make a "
                "new Pin and exchange it: world.remove(features=[old]), world.add(features=[new])."
            )
        return value

    @property
    def is_kinematic(self) -> bool:
        """Whether the particles follow the target exactly."""
        return not self.soft

    @property
    def needs_other_kernels(self) -> bool:
        """Whether the world has to be rebuilt: also when other particles are held, since their masses and slots differ."""
        return self.needs_new_state or super().needs_other_kernels

    def grab(self, scene: Scene) -> None:
        """Hold the assigned particles as a new Pin would. A Pin that drives them takes only their positions from the state."""
        memory, dev, own, kinematic, rows = scene.memory, self.dev, vars(self), self.is_kinematic, self.members.rows
        self.note_arguments()
        own.update(needs_new_state=False, changed=kinematic, moving=False, new_force=False)
        here = scene.state.get_some(memory, rows_of(rows)) if kinematic else own["target"]
        if not kinematic:
            self.start = scene.particles
            memory.write(dev.lam, np.zeros_like(here))
            dev.spring.upload(self.compliance, self.damping)
            memory.write(dev.spring.last, np.zeros(1))  # not stretched
            dev.size.set(self.start.size)
        memory.write_rows(ALL, (dev.corners.members, rows), (dev.place.source, here), (dev.place.target, here))

    def select(self, some: np.ndarray, number: np.ndarray) -> None:
        """Keep the rows in the mask `some`, with the new numbers of their particles."""
        super().select(some, number)
        self._keep(indices=self.members.indices)

    def release(self) -> None:
        """Forget the world, and which particles were held there."""
        super().release()
        self.__dict__.pop("needs_new_state", None)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check indices and targets."""
        super().prepare(particles, inv_mass)
        self._keep(dim=particles.dim)
        self.target = self.__dict__.get("target", particles.position[self.indices[:, 0]])

    def offset(self, position: np.ndarray) -> np.ndarray:
        """Return x - target, (m, dim)."""
        return position[self.indices[:, 0]] - self.scene.memory.read(self.dev.place.source)[: self.count]

    def place_of(self, scene: Scene, passes: AnchorPasses) -> "Target":
        """Make the targets at the start and the end of a frame: at first where driven particles are, or where springs draw to."""
        return Target(scene, passes, self.start.position[self.indices[:, 0]] if self.is_kinematic else self.target)

    def upload(self) -> None:
        """Write the new target, which the next frame moves to."""
        super().upload()
        if self.acts:
            self.scene.memory.write(self.dev.place.target, vars(self)["target"])
            self.moving = True
