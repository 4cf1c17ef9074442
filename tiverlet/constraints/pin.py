"""Particles held at targets."""

import numpy as np
import taichi as ti

from .. import checks
from ..compliance import law, stiff
from ..feature import Batch, Knob, Scene
from ..particles import Particles, in_range


def _targets(pin: "Pin", target):
    target = np.asarray(target)
    if target.ndim == 1:  # one point for all
        target = np.broadcast_to(target, (pin.count, len(target)))
    target = checks.points("Pin", "target", target, dim=pin.dim, count=pin.count)
    in_range("Pin", "target", target)
    return target


class Pin(Batch):
    """Particles held at targets that may move: an anchor, a hand, a mouse.

    C(x) = x - target (a vector), with unit gradients.

    indices: (m,) particles; target: (m, dim) or (dim,) [m]; None holds them where they start. Live: assign to .target between
    frames, and the particles go there in a straight line during the next frame.
    compliance: number or (m,) [m/N]. 0 takes the particles out of the solver and drives them, whatever pulls at them; above 0
    they are drawn by a spring of stiffness 1 / compliance, as by a mouse. damping: [N s/m], of that spring.
    """

    arity = 1
    dim = 0
    target = Knob(_targets, "Where the particles are held, (m, dim) [m].")

    def __init__(self, indices, target=None, *, compliance=0.0, damping=0.0):
        rows = checks.indices("Pin", "indices", indices, 2**31 - 1)
        if len(np.unique(rows)) < len(rows):
            values, counts = np.unique(rows, return_counts=True)
            raise ValueError(f"Pin: particle {values[counts > 1][0]} is named twice, and can have only one target.")
        self.indices = rows[:, None]
        self.compliance = checks.per_item("Pin", "compliance", compliance, len(rows), least=0.0)
        self.damping = checks.per_item("Pin", "damping", damping, len(rows), least=0.0)
        self.soft = bool((self.compliance > 0).any())
        if self.soft and not (self.compliance > 0).all():
            i = int(np.argmin(self.compliance > 0))
            raise ValueError(f"Pin: compliance[{i}] = 0 among positive ones. Use two Pins, one driven and one drawn.")
        if target is not None:
            self.target = target

    @property
    def drives(self) -> bool:
        """Whether the particles follow the target exactly."""
        return not self.soft

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check indices and targets; driven particles cannot be moved by anything else."""
        rows = checks.indices("Pin", "indices", self.indices[:, 0], particles.count)
        self.dim = particles.dim
        self.target = self.__dict__.get("target", particles.position[rows])
        if self.drives:
            inv_mass[rows] = 0.0

    def bind(self, scene: Scene) -> None:
        """Targets at the start and the end of a frame; for a spring, its multiplier and history."""
        Batch.bind(self, scene)
        m, dim, add = self.count, self.dim, scene.memory.field
        # A driven particle sets out from where it is; a spring is anchored at the target from the start.
        here = scene.particles.position[self.indices[:, 0]] if self.drives else self.target
        self.changed = self.drives
        self._on_from = add("Pin.from", m, width=dim, values=here, state=True)
        self._on_to = add("Pin.to", m, width=dim, values=here, state=True)
        if self.soft:
            self._on_size = scene.size
            self._on_alpha = add("Pin.compliance", m, values=self.compliance)
            self._on_damping = add("Pin.damping", m, values=self.damping)
            self._on_lam = add("Pin.multiplier", m, width=dim, state=True)
            self._on_last = add("Pin.last", m, width=dim, values=0 * here, state=True)
            self._on_history = add("Pin.history", m, width=dim)

    def upload(self) -> None:
        """Aim at the new target."""
        if self.scene and self.count:
            self.scene.memory.write(self._on_to, self.target)
            self.moving = True

    def settle(self) -> None:
        """The next frame starts from the target."""
        if self.scene and self.count:
            self.scene.memory.write(self._on_from, self.target)

    @ti.func
    def aim(self, c, when):
        """The target at the fraction `when` of the frame."""
        return self._on_from[c] * (1 - when) + self._on_to[c] * when

    @ti.func
    def drive(self, c, when):
        """Put the particle on the target."""
        i = self.member(c, 0)
        d = self.aim(c, when) - self._on_state.place(i)
        self._on_state.d[i] = d
        self._on_state.advance(i, d)

    @ti.func
    def solve(self, c, h, hh, when, first, fresh):
        """The formula of Scalar for each axis alike: multiplier before and after, and the violation that this removes."""
        i = self.member(c, 0)
        x = self._on_state.place(i)
        C, C0 = x - self.aim(c, when[1]), x - self._on_state.d[i] - self.aim(c, when[0])
        lam = self._on_lam[c]
        if first != 0:
            lam = 0 * lam
        new, size = lam, 0 * self._on_state.w[i]
        if self._on_state.w[i] > 0:
            alpha = self._on_alpha[c] / hh
            A, now, last = law(self._on_alpha[c], self._on_damping[c], h, self._on_state.w[i], fresh)
            if first != 0:
                self._on_history[c] = now * C0 + last * self._on_last[c]
                self._on_last[c] = C0
            K = A * self._on_slots.split[i] + alpha
            new = lam - self._on_slots.relaxation * (A * C + self._on_history[c] + alpha * lam) / K
            size = (new - lam).norm() * K / self._on_slots.relaxation
        return lam, new, size

    @ti.func
    def relax(self, c, h, hh, when, first, fresh):
        """Draw the particle towards the target."""
        lam, new, _ = self.solve(c, h, hh, when, first, fresh)
        self._on_lam[c] = new
        self.push(c, 0, self._on_w[self.member(c, 0)] * (new - lam))

    @ti.func
    def kick(self, c, h):
        """As in Scalar, for each axis: towards the target, which is at rest at the end of a frame."""
        i = self.member(c, 0)
        w, alpha = self._on_w[i], self._on_alpha[c]
        if w > 0:
            resolved = 1 - stiff(alpha, h, w)
            C = self._on_state.place(i) - self.aim(c, 1)
            self.push(c, 0, -h * h * w * resolved * (C / alpha + self._on_damping[c] * self._on_state.d[i] / h))

    @ti.func
    def miss(self, c, h, hh, when, fresh):
        """What is left, relative to the size of the scene."""
        _, _, size = self.solve(c, h, hh, when, 0, fresh)
        return size / self._on_size

    @ti.func
    def energy(self, c, back):
        """|C|^2 / (2 alpha)."""
        i = self.member(c, 0)
        C = self._on_state.place(i) - back * self._on_state.d[i] - self._on_to[c]
        return ti.cast(C.dot(C) / (2 * self._on_alpha[c]), ti.f64)
