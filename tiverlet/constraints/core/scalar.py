"""Constraints that are one number, C = f - rest: how a substep fulfils them, from soft to rigid."""

from ...device import ti
from ...features.feature import FAR, Scene
from .compliant import Elastic

# Where constraints converge within a substep, SHAKE is an explicit method for what is across them, with its limits:
TENSEST = 4.0  # (omega h)^2 of a vibration across a tension, beyond which Verlet diverges
LOST = 0.015  # violation at the start of a substep, relative to the size, from where on its direction would bring in energy


class Scalar(Elastic):
    """Constraints C(x) = f(x) - rest = 0, >= 0 or <= 0, soft or rigid, from `measure`. numerics: one formula for all.

        theta = s^4 / (1 + s^4), s^2 = (omega h)^2 = w h^2 / alpha     0: resolved by the step, 1: rigid
        C*    = (1 - theta) (C_(n+1) + 2 C_n + C_(n-1)) / 4 + theta C_(n+1)
        dlam  = -(A C + B + alpha' lam) / (A W + alpha'),  A = (1 - theta)/4 + theta,  alpha' = alpha / h^2
        dx_j  = w_j dlam grad_j C(x_n)

    W = sum_j n_j w_j grad_j C(x_(n+1)) . grad_j C(x_n) is the mass-split weight: particle j belongs to n_j constraints, and
    gives each an n_j-th of its mass (Tonge 2012), which keeps the sum of all corrections stable and conserves momentum.
    The direction is that at the start of the step, x_n (SHAKE, Ryckaert 1977): second order and no loss of energy. When a
    constraint turns by more than 41 degrees in a step, or has no direction at x_n, the current direction takes its place.

    In the first substep after a start (`fresh`) the force acts for half a kick, alpha' = alpha / (h^2 / 2), and C* is made of
    C_(n+1) and C_n.
    With drag, alpha' = alpha / (phi h^2) with the factor phi that the exact solution gives every other acceleration.
    """

    precise = False  # whether exactly() measures to all the digits that positions have
    cusp = False  # whether any goal is f = 0, where gradients end: no direction at the start of the step means anything there
    collapses = 0  # the power of a length that f is, where gradients vanish with the size of the body; else 0

    @property
    def joins(self) -> bool:
        """Whether constraints of the batch can be solved together with others: few corners, and a direction everywhere."""
        return self.arity > 0 and not self.collapses

    def bind(self, scene: Scene) -> None:
        """Declare what solvers need: which rows of a system constraints are, and how they are relaxed."""
        super().bind(scene)
        name, m, add = repr(self), self.count, scene.memory.field
        rows = scene.slots.rows(self)
        self.dev.told, self.dev.alone = bool((rows >= 0).any()), bool((rows < 0).any())
        if self.dev.told:
            self.dev.row = add(f"{name}.row", m, kind=ti.i32, values=rows)
        self.dev.cusp = self.cusp
        self.dev.firm = self.joins and (self.dev.told or scene.slots.accelerates)
        if self.dev.firm:
            self.dev.close = add(f"{name}.close", m, values=self.closeness(self.start.position))
        self.dev.hurries = self.dev.firm and scene.slots.accelerates and self.dev.alone and self.side == 0
        if self.dev.hurries:
            self.dev.step = add(f"{name}.step", m)

    @ti.func
    def known(self, c, h, hh, first, fresh):
        """What every solver knows of constraint c in a pass; of the state it writes nothing but the memory of soft constraints.

        Returns the violation A C + B + alpha' lam, A, alpha', lam, the mass-split weight W (0: no corner can move), directions n
        and gradients g, both (arity, dim), and how far it turned, see Slots.note; n is g where it turned too far.
        """
        if first != 0:
            self.begin(c, fresh)
        now, start = self.ends(c)
        f, g = self.measure(c, now)
        f0, n = self.measure(c, start)
        f0 = self.near(f0, self.dev.rest[c])
        f = self.near(f, f0)
        w = ti.cast(0, self.dev.real)  # sum of w |grad|^2, then mass-split: along both, current, start
        both, here, there = ti.cast(0, self.dev.real), ti.cast(0, self.dev.real), ti.cast(0, self.dev.real)
        for k in ti.static(range(self.arity)):
            i = self.member(c, k)
            gg, split = g[k, :].dot(g[k, :]), self.dev.slots.split[i]
            w += self.dev.w.of(i) * gg
            both += split * g[k, :].dot(n[k, :])
            here += split * gg
            there += split * n[k, :].dot(n[k, :])
        turn = self.dev.slots.turn(both, ti.sqrt(here * there))
        lost = turn == FAR
        if ti.static(self.dev.cusp):
            lost = lost or (self.dev.rest[c] == 0 and self.is_rigid(c))
        if ti.static(self.dev.firm):
            if self.is_rigid(c):
                lost = lost or ti.abs(self.bounded(f0 - self.dev.rest[c])) * self.dev.close[c] > LOST
        if lost:
            n, both = g, here
        violation, A, alpha, lam, W = self.equation(c, f, f0, w, both, h, hh, first, fresh)
        return violation, A, alpha, lam, W, n, g, turn * ti.cast(self.distinct(f, f0), ti.i32)

    @ti.func
    def answer(self, violation, A, alpha, lam, W, turn):
        """The multiplier of a Jacobi pass, and the size of the violation that it removes."""
        new, size = lam, ti.cast(0, self.dev.real)
        if W > 0:
            new = lam - self.dev.slots.relaxation * violation / (A * W + alpha)
            if ti.static(self.side != 0):
                new = -self.bounded(-new)
            size = ti.abs(new - lam) * (A * W + alpha) / self.dev.slots.relaxation
            if new != lam:
                self.dev.slots.note(turn)
        return new, size

    @ti.func
    def tempered(self, c, lam, new, extent, move):
        """Next to where it has no direction, f is curved: no pass moves corners further than they are, or are to be, apart.

        extent: squared size of the body. move: squared size of what a multiplier of 1 moves.
        """
        size = ti.abs(self.dev.rest[c])
        if ti.static(self.collapses == 2):
            size = ti.sqrt(size)
        else:
            size = ti.pow(size, ti.static(1 / self.collapses))
        reach = ti.sqrt(extent) + size
        far = ti.abs(new - lam) * ti.sqrt(move)
        if far > reach:
            new = lam + (new - lam) * (reach / far)
        return new

    @ti.func
    def relax(self, c, h, hh, when, first, fresh):
        """Move each corner by w_j dlam grad_j C; a constraint that belongs to a system tells it what it knows."""
        violation, A, alpha, lam, W, n, g, turn = self.known(c, h, hh, first, fresh)
        step = ti.cast(1, self.dev.real)
        if ti.static(self.dev.told):
            row = self.dev.row[c]
            if row >= 0:
                self.dev.slots.system.tell(row, violation, A, alpha, lam, W, self.lever(c, W))
                for k in ti.static(range(self.arity)):
                    self.dev.slots.system.lean(self.dev.places[c][k], self.member(c, k), g[k, :])
                if violation != 0:
                    self.dev.slots.note(turn)
        if ti.static(self.dev.alone):
            if self.relaxed_alone(c):
                new, _ = self.answer(violation, A, alpha, lam, W, turn)
                if ti.static(self.collapses > 0):
                    move = ti.cast(0, self.dev.real)
                    for k in ti.static(range(self.arity)):
                        w = self.dev.w.of(self.member(c, k))
                        move += w * w * n[k, :].dot(n[k, :])
                    new = self.tempered(c, lam, new, self.corners(c, 0).norm_sqr(), move)
                step = new - lam
                if ti.static(self.dev.hurries):
                    last = self.dev.step[c]
                    if first != 0:
                        last = 0
                    most = TENSEST / self.lever(c, W / 2)  # split by two in a chain
                    wanted = lam + self.dev.slots.hurried(last, step)
                    step = ti.max(-most, ti.min(most, wanted)) - lam
                    self.dev.step[c] = step
                    if ti.abs(wanted) >= most:
                        ti.atomic_max(self.dev.slots.tension[None], ti.cast(TENSEST * ti.abs(wanted) / most, ti.f64))
                    new = lam + step
                self.dev.lam[c] = new
        for k in ti.static(range(self.arity)):
            self.push(c, k, self.dev.w.of(self.member(c, k)) * step * n[k, :])

    @ti.func
    def lever(self, c, W):
        """(omega h)^2 of the fastest vibration across a tension, for a multiplier of 1: of a chain 4 w / l, where W = 2 w."""
        return 2 * W * self.dev.close[c]

    @ti.func
    def relaxed_alone(self, c):
        """Whether constraint c belongs to no system."""
        out = True
        if ti.static(self.dev.told):
            out = self.dev.row[c] < 0
        return out

    @ti.func
    def take(self, c, first):
        """Add what the system has found to the multiplier."""
        if ti.static(self.dev.told):
            row = self.dev.row[c]
            if row >= 0:
                step = ti.cast(self.dev.slots.system.step[row], self.dev.real)
                if first != 0:
                    self.dev.lam[c] = step
                else:
                    self.dev.lam[c] = self.dev.lam[c] + step

    @ti.func
    def miss(self, c, h, hh, when, fresh):
        """The violation that is left, relative to the rest value (to the batch's mean f where that is 0)."""
        violation, A, alpha, lam, W, _, _, _ = self.known(c, h, hh, 0, fresh)
        _, left = self.answer(violation, A, alpha, lam, W, 0)
        if ti.static(self.collapses > 0):
            f, g = self.measure(c, self.corners(c, 0))
            if g.norm_sqr() == 0 and self.holds(c):
                left = ti.abs(self.bounded(f - self.dev.rest[c]))
        return left / self.extent(c)
