"""The passes over clusters of particles that keep their shape."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...device import ti
from ...geometry import rotation
from .cluster_impact import ClusterImpact
from .passes import Passes
from .spring import FIRM, Spring, stiff
from .strength import Strength

if TYPE_CHECKING:
    from ...features.feature import Scene

LEAST = 2.0**-46  # smaller relative changes of a rotation are rounding


class ClusterPasses(Passes):
    """The passes of a ShapeMatch, in the loops of VariableCorners; ShapeMatch defines c, R and q.

    Blocks sum up moments, from which each cluster computes its position and rotation. Then corners move towards their places
    there.

    turn, place: R, as a quaternion or (cos, sin), and c. pose: R as a matrix. fit, middle: R and c at the start of the substep.
    mean: of the other terms of the violation, which shift nothing. pull: the move of each corner in a substep.
    shape: rest shape about the center of each cluster, (total, dim). radius: of each cluster, (m,).
    """

    def __init__(self, scene: "Scene", batch: Any, shape: np.ndarray, radius: np.ndarray):
        self.name = name = repr(batch)
        dim, m, add = scene.state.dim, batch.count, scene.memory.field
        self.state, self.slots, self.w, self.real = scene.state, scene.slots, scene.state.w, scene.real
        self.corners = batch.members.bind(scene, batch)
        self.plastic = batch.transcends
        w, owner, total = scene.inv_mass[batch.indices], batch.owner, len(shape)
        mass = np.bincount(owner, weights=np.divide(1, w, where=w > 0, out=np.zeros_like(w)), minlength=m)
        self.mass = add(f"{name}.mass", m, values=mass)
        self.size = add(f"{name}.radius", m, values=np.maximum(radius, 1e-6 * batch.start.size))
        self.shape = add(f"{name}.shape", total, width=dim, values=shape, state=self.plastic)
        turn = rotation.identity(dim)
        self.pull: Any = add(f"{name}.multiplier", total, width=dim, state=True)
        self.strength = Strength(scene, name, batch, self.corners)
        self.turn = add(f"{name}.turn", m, width=len(turn), kind=ti.f64, values=[turn] * m, state=True)
        for_reports = bool(scene.state.sleepers)  # the report reads it for clusters that sleep, in a clone too
        self.pose = add(f"{name}.pose", m, width=dim * dim, kind=ti.f64, state=for_reports)
        self.place = add(f"{name}.place", m, width=dim, kind=ti.f64, state=for_reports)

        def moment(what, width):
            """Add a field with a row for each block, to be summed up."""
            return add(f"{name}.{what}", self.corners.block_count, width=width, kind=ti.f64)

        self.total = moment("total", 0)
        self.p, self.q, self.s = moment("p", dim), moment("q", dim), moment("s", dim)
        self.K, self.X = moment("K", dim * dim), moment("X", dim * dim)
        compliance, damping = (batch.compliance, batch.damping) if batch.soft else (None, None)
        self.spring: Any = Spring(scene, name, compliance, damping, np.zeros((total, dim)))
        if self.spring.soft:
            self.v, self.U = moment("v", dim), moment("U", dim * dim)
            self.fit = add(f"{name}.fit", m, width=dim * dim, kind=ti.f64, state=for_reports)
            self.middle = add(f"{name}.middle", m, width=dim, kind=ti.f64)
            self.mean = add(f"{name}.mean", m, width=dim, kind=ti.f64, state=for_reports)
        self.joins = bool((scene.slots.rows(batch) >= 0).any())
        if self.joins:  # whether a system takes it as a body, see Joined
            self.joined = add(f"{name}.joined", m, kind=ti.i32, values=scene.slots.rows(batch) >= 0)
        if scene.slots.answers:  # see turn_answer()
            self.inertia = add(f"{name}.inertia", m, width=dim * dim, kind=ti.f64)  # sum m r r^T about the middle
            self.answering = add(f"{name}.answering", m, width=3, kind=ti.f64)  # A, alpha' and the mass
            self.arm = add(f"{name}.arm", total, width=dim, kind=ti.f64)  # from the middle
            self.weight = add(f"{name}.weight", total, width=2, kind=ti.f64)  # mass, and 1 / (A n + alpha')
            self.answered = add(f"{name}.answered", total, width=dim, state=True)  # in the last substep
            self.pressed = add(f"{name}.pressed", total)  # by how many rows, of contacts
            self.blow = add(f"{name}.blow", total, width=dim, state=True)  # the part of `pull` that is over
        self.impacts: Any = scene.impacts
        self.impact: Any = ClusterImpact(self, scene.impacts) if scene.impacts else None
        if self.plastic:
            self.creep = add(f"{name}.creep", m, values=batch.creep)
            self.yield_size = add(f"{name}.yield", m, values=batch.yield_strain * radius)

    @ti.func
    def zero_vector(self) -> Any:
        """Return a vector of zeros. A product of 0 and a field may be NaN."""
        return ti.Vector.zero(ti.f64, self.state.dim)

    @ti.func
    def relative_position(self, e, i0, back):
        """Return corner e relative to particle i0, at x - back d, in f64."""
        return self.state.between_before(self.corners.members[e], i0, back)

    @ti.func
    def law(self, c, h, h2_effective, fresh):
        """Return the coefficients of C_(n+1) (rigid part, soft part), C_n and C_(n-1), and alpha M / h^2: alpha' of a move."""
        rigid, soft = ti.cast(1, self.real), ti.cast(0, self.real)
        now, last, alpha_prime = 0 * soft, 0 * soft, 0 * soft
        if ti.static(self.spring.soft):
            alpha, mass = self.spring.alpha[c], self.mass[c]
            if alpha > 0 and mass > 0:
                soft, now, last = self.spring.law(c, h, 1 / mass, fresh)
                if soft < 1 / 64:  # at a start it would be 0 for soft springs, but c and R have to be determined
                    soft, now = ti.cast(1 / 64, self.real), now + soft - 1 / 64
                rigid = ti.min(self.spring.stiff(c, h, 1 / mass), soft)
                soft -= rigid
                alpha_prime = alpha * mass / h2_effective
        return rigid, soft, now, last, alpha_prime

    @ti.func
    def mass_in_pass(self, e, A, alpha_prime):
        """Return mu of corner e in a pass: its mass, times its move for a violation of 1."""
        i = self.corners.members[e]
        w, mu = self.w[i], ti.cast(rotation.HEAVY * self.mass[self.corners.owner[e]], ti.f64)
        if w > 0:
            mu = 1 / ti.cast(A * self.slots.split[i] + alpha_prime * w, ti.f64)
        return mu

    @ti.func
    def mass_of(self, e, c, heavy=rotation.HEAVY):
        """Return the mass of corner e, `heavy` times that of its cluster c for a particle that cannot move."""
        w, mu = self.w[self.corners.members[e]], ti.cast(heavy * self.mass[c], ti.f64)
        if w > 0:
            mu = ti.cast(1, ti.f64) / w
        return mu

    @ti.func
    def reduce_block(self, b, h, h2_effective, first, fresh):
        """Sum the moments of a block about the positions s at the start.

        They are of shapes q, of predicted positions p, and of the other violation terms. With first < 0, s are the present
        positions.
        """
        begin, end, c = self.corners.block[b]
        i0 = self.corners.reference_particle(c)
        rigid, soft, now, last, alpha_prime = self.law(c, h, h2_effective, fresh)
        total, p1, q1, s1 = ti.cast(0, ti.f64), self.zero_vector(), self.zero_vector(), self.zero_vector()
        K = p1.outer_product(p1)
        X, v1, U = 0 * K, 0 * p1, 0 * K
        for e in range(begin, end):
            mu, p = self.mass_in_pass(e, rigid + soft, alpha_prime), self.relative_position(e, i0, 0)
            q, s = self.shape[e], self.relative_position(e, i0, 1)
            if first < 0:
                mu, s = self.mass_of(e, c), p
            total += mu
            p1 += mu * p
            q1 += mu * q
            s1 += mu * s
            K += (mu * q).outer_product(s)
            X += (mu * p).outer_product(s)
            if ti.static(self.spring.soft):
                v = mu * last * self.spring.last_value(e, ti.cast(self.zero_vector(), self.real), fresh)
                if first == 0:
                    v = mu * (self.spring.history[e] + alpha_prime * self.pull[e])
                v1 += v
                U += v.outer_product(s)
        self.total[b], self.p[b], self.q[b], self.s[b] = total, p1, q1, s1
        rotation.write_rows(self.K, b, K)
        rotation.write_rows(self.X, b, X)
        if ti.static(self.spring.soft):
            self.v[b] = v1
            rotation.write_rows(self.U, b, U)

    @ti.func
    def moments(self, c):
        """Return the sum of mu, the means of p, q and s, and the moments of q and p about these means."""
        total, p, q, s = ti.cast(0, ti.f64), self.zero_vector(), self.zero_vector(), self.zero_vector()
        K = p.outer_product(p)
        X = 0 * K
        for b in range(self.corners.blocks[c], self.corners.blocks[c + 1]):
            total += self.total[b]
            p += self.p[b]
            q += self.q[b]
            s += self.s[b]
            K += rotation.from_rows(self.K[b])
            X += rotation.from_rows(self.X[b])
        p, q, s = p / total, q / total, s / total
        return total, p, q, s, K - total * q.outer_product(s), X - total * p.outer_product(s)

    @ti.func
    def is_firm(self, c, h):
        """Whether cluster c is rigid in impacts, for a substep h."""
        out = self.mass[c] > 0
        if ti.static(self.spring.soft):
            if out and self.spring.alpha[c] > 0:
                out = stiff(self.spring.alpha[c], h, 1 / self.mass[c]) > FIRM
        return out

    @ti.func
    def is_body(self, c):
        """Whether cluster c shares no particle that can move, so that it moves as a body in impacts."""
        out = True
        for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
            i = self.corners.members[e]
            w = self.w[i]
            out = out and (w == 0 or self.slots.split[i] < 2 * w)
        return out

    @ti.func
    def relax(self, c, h, h2_effective, frame_fraction, first, fresh):
        """Compute the position and rotation of the cluster; in an extra pass, let it leave walls that it struck."""
        extra = False
        if ti.static(bool(self.impacts)):
            extra = self.impacts.is_extra_pass()
            if extra:
                self.impact.strike(c)
        if not extra and self.mass[c] > 0:
            total, p, q, s, K, X = self.moments(c)
            rigid, soft, now, last, alpha_prime = self.law(c, h, h2_effective, fresh)
            mean, U = 0 * p, 0 * K
            if ti.static(self.spring.soft):
                for b in range(self.corners.blocks[c], self.corners.blocks[c + 1]):
                    mean += self.v[b] / total
                    U += rotation.from_rows(self.U[b])
                U -= total * mean.outer_product(s)
            start, end, cosine = rotation.step_rotation(K, X, U, first > 0, rigid, soft, self.turn[c], LEAST, self.spring.soft)
            pose = rotation.matrix(end)
            self.place[c] = p - pose @ q
            if not ti.math.isnan(end.sum()):  # type: ignore[reportOptionalCall]
                # A NaN is not stored: the cluster keeps its last rotation.
                self.turn[c] = end
            rotation.write_rows(self.pose, c, pose)
            self.slots.record_turn(self.slots.classify_turn(cosine, 1.0))
            if ti.static(self.spring.soft):
                R = rotation.matrix(start)
                if first > 0:  # in the body frame
                    mean = R @ mean
                self.middle[c], self.mean[c] = s - R @ q, mean
                rotation.write_rows(self.fit, c, R)

    @ti.func
    def begin_answer(self, c, h, h2_effective, fresh, bodies: ti.template()):  # type: ignore[valid-type]
        """Store the law of cluster c in this substep. Without shared particles, all rows that press on it share its mass."""
        begin, end = self.corners.starts[c], self.corners.starts[c + 1]
        rigid, soft, _now, _last, alpha_prime = self.law(c, h, h2_effective, fresh)
        self.answering[c][0], self.answering[c][1] = rigid + soft, alpha_prime
        if self.is_body(c) and self.strength.is_intact(c) and self.mass[c] > 0:
            share, eigenvalue = 0 * rigid, 0 * rigid
            for e in range(begin, end):
                self.pressed[e] = bodies.rows.share[self.corners.members[e]]
                share += self.pressed[e]
                eigenvalue += bodies.rows.eigenvalue[self.corners.members[e]]
            for e in range(begin, end):
                bodies.rows.share[self.corners.members[e]], bodies.rows.eigenvalue[self.corners.members[e]] = share, eigenvalue

    @ti.func
    def turn_answer(self, c, bodies: ti.template()):  # type: ignore[valid-type]
        """Find how cluster c moves as a rigid body in an impact. Shared particles count with a part of their mass."""
        begin, end, i0 = self.corners.starts[c], self.corners.starts[c + 1], self.corners.reference_particle(c)
        total, middle, own = ti.cast(0, ti.f64), self.zero_vector(), self.is_body(c) and self.strength.is_intact(c)
        back = 1 - bodies.rows.when_of(self.corners.members[begin])
        S, A, alpha = middle.outer_product(middle), self.answering[c][0], self.answering[c][1]
        for e in range(begin, end):
            i, r = self.corners.members[e], self.relative_position(e, i0, back)
            m = self.mass_in_pass(e, A, alpha)
            if self.w[i] > 0:
                m *= A + alpha
            total += m
            middle += m * r
            S += m * r.outer_product(r)
            self.arm[e], self.weight[e][0], self.weight[e][1] = r, m, m * self.w[i] / (A + alpha)
        middle /= total
        S -= total * middle.outer_product(middle)
        for e in range(begin, end):
            self.arm[e] = self.arm[e] - middle
        rotation.write_rows(self.inertia, c, S)
        self.answering[c][2] = total
        if own and self.mass[c] > 0:
            give, rows, arm, turns, free = alpha / (A + alpha), 0 * total, self.zero_vector(), 0 * total, 0 * A
            for e in range(begin, end):
                i, turning = self.corners.members[e], rotation.turning_compliance(S, self.arm[e])
                w, body = self.w[i], ti.cast(1 / total + turning, self.real)
                bodies.answers.mobility[i] = give * w + (1 - give) * ti.min(body, w)
                rows += self.pressed[e]
                arm += self.pressed[e] * self.arm[e]
                turns += self.pressed[e] * turning
                free = ti.max(free, w)
            # The largest eigenvalue of [[rows / M, R], [R^T, turns]], with |R|^2 = turning_compliance(S, arm) / M.
            moves, coupled = rows / total, rotation.turning_compliance(S, arm) / total
            largest = (moves + turns + ti.sqrt((moves - turns) ** 2 + 4 * coupled)) / 2
            shared = free
            if rows > 0:
                shared = ti.min(ti.cast(largest / rows, self.real), free)
            for e in range(begin, end):
                i = self.corners.members[e]
                bodies.answers.shared[i] = give * self.w[i] + (1 - give) * shared

    @ti.func
    def answer(self, c, moved: ti.template(), d: ti.template()):  # type: ignore[valid-type]
        """Move corners to a rigid motion of the cluster, as far as it is stiff: A (C of the moves) + alpha' answer = 0."""
        begin, end = self.corners.starts[c], self.corners.starts[c + 1]
        by_itself = self.mass[c] > 0 and self.strength.is_intact(c)
        if ti.static(self.joins):
            by_itself = by_itself and self.joined[c] == 0
        if by_itself:
            mean, some = self.zero_vector(), False
            S, A, alpha = rotation.from_rows(self.inertia[c]), self.answering[c][0], self.answering[c][1]
            X = 0 * S
            for e in range(begin, end):
                step = moved[self.corners.members[e]] - d[self.corners.members[e]]
                move = self.weight[e][0] * (A * ti.cast(step, ti.f64) + alpha * self.answer_of(e))
                some = some or (step != 0).any()
                mean += move
                X += self.arm[e].outer_product(move)
            if some:
                mean /= self.answering[c][2]
                spin = rotation.rigid_rotation(S, X)
                for e in range(begin, end):
                    i, place = self.corners.members[e], self.corners.places[e]
                    if place >= 0:
                        C, before = ti.cast(moved[i] - d[i], ti.f64), self.answer_of(e)
                        change = (A * C + alpha * before - mean - spin @ self.arm[e]) * self.weight[e][1]
                        self.slots.answer[place] = ti.cast(before - change, self.real)

    @ti.func
    def answer_of(self, e):
        """Return the answer to corner e so far [m]."""
        out = self.zero_vector()
        if self.corners.places[e] >= 0:
            out = ti.cast(self.slots.answer[self.corners.places[e]], ti.f64)
        return out

    @ti.func
    def end_answer(self, c, rows: ti.template()):  # type: ignore[valid-type]
        """Add the answer to the moves of the corners. Unless it is steady, it came of a blow."""
        change, size, slight = ti.cast(0, self.real), ti.cast(0, self.real), ti.cast(0, self.real)
        for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
            i, place = self.corners.members[e], self.corners.places[e]
            if place >= 0:
                answer, m = self.slots.answer[place], 1 / self.w[i]
                change += m * (answer - rows.scale[None] * self.answered[e]).norm()
                size += m * answer.norm()
                slight += m * rows.kick(i).norm()
        for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
            place = self.corners.places[e]
            if place >= 0:
                answer = self.slots.answer[place]
                self.pull[e], self.answered[e] = self.pull[e] + answer, answer
                self.blow[e] = ti.select(rows.is_steady(change, size, slight), 0 * answer, answer)

    @ti.func
    def push_spring_force(self, c, h, soft, alone):
        """Compute the present position and rotation, for scatter_corner(), which adds h^2 times the spring acceleration."""
        if self.mass[c] > 0:
            total, p, q, s, K, X = self.moments(c)
            R = rotation.matrix(rotation.fit(K, self.turn[c], LEAST))
            self.place[c] = s - R @ q
            rotation.write_rows(self.pose, c, R)

    @ti.func
    def push_reaction(self, c, h, firm, soft):
        """Push the move of each corner, less the mean and the moment of all moves about the present positions.

        The moment is removed as the rotation of least sum m move^2. Moves have no mean and no moment about the positions at the
        start. Where a particle cannot move, outside forces give both, and nothing is removed.
        """
        begin, end, i0 = self.corners.starts[c], self.corners.starts[c + 1], self.corners.reference_particle(c)
        middle, center, R = self.best_fit(c, 0)
        total, mean, pull, held = ti.cast(0, ti.f64), self.zero_vector(), self.zero_vector(), False
        S = mean.outer_product(mean)
        X = 0 * S
        for e in range(begin, end):
            held = held or self.w[self.corners.members[e]] == 0
            m, r = self.mass_of(e, c), self.relative_position(e, i0, 0)
            move = self.reaction(e, c, middle, center, R, h, firm, soft)
            total += m
            mean += m * r
            pull += m * move
            S += m * r.outer_product(r)
            X += m * r.outer_product(move)
        mean, pull = mean / total, pull / total
        spin = rotation.rigid_rotation(S - total * mean.outer_product(mean), X - total * mean.outer_product(pull))
        for e in range(begin, end):
            move = self.reaction(e, c, middle, center, R, h, firm, soft)
            if not held:
                move -= pull + spin @ (self.relative_position(e, i0, 0) - mean)
            self.corners.write_move(e, ti.cast(move, self.real))

    @ti.func
    def reaction(self, e, c, middle, center, R, h, firm, soft):
        """Return the last move of corner e, plus the change of its spring force since; 0 if broken. middle: see best_fit()."""
        pull = ti.cast(self.pull[e], ti.f64)
        if ti.static(self.slots.answers):
            pull -= ti.cast(self.blow[e], ti.f64)
        move = firm * pull
        if ti.static(self.spring.soft):
            w, mass = self.w[self.corners.members[e]], self.mass[c]
            if self.spring.alpha[c] > 0:
                move = soft * pull
                if w > 0 and self.strength.is_intact(c):
                    C = self.relative_position(e, self.corners.reference_particle(c), 0) - middle - R @ (self.shape[e] - center)
                    grown = ti.cast(C - R @ ti.cast(self.spring.last[e], ti.f64), self.real)
                    n = self.slots.split[self.corners.members[e]] / w
                    move += ti.cast(self.spring.force_change(c, grown / mass, h, 1 / mass, n / mass), ti.f64)
        if ti.static(self.strength.breaks):
            if not self.strength.is_intact(c):
                move = 0 * move
        if ti.static(bool(self.impacts)):
            if self.impacts.reached[self.corners.members[e]] != 0:  # a blow is over
                move = 0 * move
        return move

    @ti.func
    def best_fit(self, c, back):
        """Return, for a soft cluster c at x - back d, the mean position, the mean of its shape, and the best-fit rotation."""
        middle, center = self.zero_vector(), self.zero_vector()
        R = middle.outer_product(center)
        if ti.static(self.spring.soft):
            total, K, i0 = ti.cast(0, ti.f64), R, self.corners.reference_particle(c)
            for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
                mu = self.mass_of(e, c)
                x = self.relative_position(e, i0, back)
                total += mu
                middle += mu * x
                center += mu * self.shape[e]
                K += mu * self.shape[e].outer_product(x)
            middle, center = middle / total, center / total
            R = rotation.matrix(rotation.fit(K - total * center.outer_product(middle), self.turn[c], LEAST))
        return middle, center, R

    @ti.func
    def offset_of(self, e, c):
        """Return C_i at the present positions."""
        x = self.relative_position(e, self.corners.reference_particle(c), 0)
        return x - self.place[c] - rotation.from_rows(self.pose[c]) @ self.shape[e]

    @ti.func
    def scatter_corner(self, e, h, h2_effective, first, fresh):
        """Move corner e towards its place; in an extra pass, relax() has written its move."""
        extra = False
        if ti.static(bool(self.impacts)):
            extra = first >= 0 and self.impacts.is_extra_pass()
        if not extra:
            self.move_to_place(e, h, h2_effective, first, fresh)

    @ti.func
    def move_to_place(self, e, h, h2_effective, first, fresh):
        """Move corner e towards its place."""
        c, i = self.corners.owner[e], self.corners.members[e]
        w, relaxation = self.w[i], self.slots.relaxation
        if first > 0:
            self.pull[e] = ti.cast(self.zero_vector(), self.real)
        if not self.strength.is_intact(c):
            self.corners.write_move(e, ti.cast(self.zero_vector(), self.real))
        elif w > 0:
            C, n = self.offset_of(e, c), self.slots.split[i] / w
            if ti.static(not self.spring.soft):
                move = ti.cast(-relaxation * C / n, self.real)
                if first >= 0:
                    self.pull[e] = self.pull[e] + move
                self.corners.write_move(e, move)
            elif first < 0:
                self.corners.write_move(e, ti.cast(self.spring_move(e, c, C, h), self.real))
            else:
                rigid, soft, now, last, alpha_prime = self.law(c, h, h2_effective, fresh)
                if first > 0:
                    self.store_history(e, c, h, now, last, fresh)
                C = self.soft_violation(e, c, C, rigid, soft, alpha_prime)
                move = ti.cast(-relaxation * C / ((rigid + soft) * n + alpha_prime), self.real)
                self.pull[e] = self.pull[e] + move
                self.corners.write_move(e, move)

    @ti.func
    def soft_violation(self, e, c, C, rigid, soft, alpha_prime):
        """Return C* + alpha' lam of a soft cluster, with the soft part of C_(n+1) = C in the frame at the start."""
        back = rotation.from_rows(self.fit[c]) @ (rotation.from_rows(self.pose[c]).transpose() @ C)
        return rigid * C + soft * back + self.spring.history[e] + alpha_prime * self.pull[e] - self.mean[c]

    @ti.func
    def store_history(self, e, c, h, now, last, fresh):
        """Store the terms of C_n and C_(n-1) in the violation; and let a plastic shape flow."""
        R = rotation.from_rows(self.fit[c])
        C = self.relative_position(e, self.corners.reference_particle(c), 1) - self.middle[c] - R @ self.shape[e]
        self.spring.history[e] = now * C + last * (R @ self.spring.last_value(e, ti.cast(self.zero_vector(), self.real), fresh))
        body = R.transpose() @ C
        if ti.static(self.plastic):
            size = body.norm()
            if size > self.yield_size[c]:
                flow = (1 - ti.exp(-self.creep[c] * h)) * (1 - self.yield_size[c] / size) * body
                self.shape[e] = self.shape[e] + flow
                body -= flow
        self.spring.last[e] = body

    @ti.func
    def spring_move(self, e, c, C, h):
        """Return h^2 times the acceleration of corner e by spring and dashpot, as far as the step resolves them."""
        alpha, mass = self.spring.alpha[c], self.mass[c]
        out = 0 * C
        if alpha > 0:
            rate = (C - rotation.from_rows(self.pose[c]) @ self.spring.last[e]) / h
            out = -h * h * (1 - self.spring.stiff(c, h, 1 / mass)) * (C / alpha + self.spring.damping[c] * rate) / mass
        return out

    @ti.func
    def overload(self, c, h2_rigid, h2_effective):
        """Return by how much the force on a particle of cluster c was too large, see Strength."""
        out = 0 * h2_rigid
        if self.strength.is_intact(c):
            w, i0 = self.mass[c], self.corners.reference_particle(c)
            if w > 0:
                w = 1 / w
            per_newton = self.spring.multiplier_per_newton(c, w, h2_rigid, h2_effective)
            for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
                i = self.corners.members[e]
                if self.w[i] > 0:
                    past = self.strength.add_excess(c, e, self.pull[e] / self.w[i], per_newton)
                    if past > self.strength.rounding(c, i, i0):
                        out = ti.max(out, self.strength.overload_by(c, past, per_newton))
        return out

    @ti.func
    def residual_of(self, c, h, h2_effective, frame_fraction, fresh):
        """Return the largest violation that is left, relative to the radius, with the rotation of the last pass."""
        worst, total, mean, holds = ti.cast(0, ti.f64), ti.cast(0, ti.f64), self.zero_vector(), self.strength.is_intact(c)
        rigid, soft, now, last, alpha_prime = self.law(c, h, h2_effective, fresh)
        for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
            total += self.mass_of(e, c)
            mean += self.mass_of(e, c) * self.offset_of(e, c)
        for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
            if self.w[self.corners.members[e]] > 0 and holds:
                C = self.offset_of(e, c) - mean / total  # positions are relative to a particle that has moved since
                if ti.static(self.spring.soft):
                    C = self.soft_violation(e, c, C, rigid, soft, alpha_prime)
                worst = ti.max(worst, C.norm())
        return ti.cast(worst / self.size[c], self.real)

    @ti.func
    def energy(self, c, back, h2_effective, residual):
        """Return the elastic energy [J] about the best fit at x - back d, of the part that bears loads, see Spring."""
        out = ti.cast(0, ti.f64)
        if ti.static(self.spring.soft):
            alpha, mass, i0 = self.spring.alpha[c], self.mass[c], self.corners.reference_particle(c)
            if alpha > 0 and mass > 0 and self.strength.is_intact(c):
                s, q, R = self.best_fit(c, back)
                most, borne = ti.cast(0, self.real), ti.cast(0, ti.f64)
                for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
                    C = self.relative_position(e, i0, back) - s - R @ (self.shape[e] - q)
                    if self.w[self.corners.members[e]] > 0:
                        out += C.dot(C) / (2 * alpha * mass * self.w[self.corners.members[e]])
                        most = ti.max(most, self.pull[e].norm())
                        pull = ti.cast(self.pull[e].norm(), ti.f64)
                        if h2_effective > 0:
                            pull /= h2_effective
                        borne += pull * pull * alpha * mass / (2 * self.w[self.corners.members[e]])
                out *= self.spring.bearing_share(most * alpha * mass, h2_effective, residual * self.size[c])
                out = self.spring.energy(c, 1 / mass, h2_effective, out, borne)
        return out
