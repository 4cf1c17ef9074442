"""The substep in NumPy and f64, slow and plain: kernels have to agree with it for every particle."""

import numpy as np


class Prototype:
    """Gravity and links: half-kick start, mass-split Jacobi, direction at the start of the step, soft to rigid in one formula."""

    def __init__(self, x, v, w, pairs, rest, alpha, damping, g):
        self.x, self.d, self.w, self.g = x.copy(), v.copy(), w, np.asarray(g)
        self.i, self.j = pairs.T
        self.rest, self.alpha, self.damping = rest, alpha, damping
        share = np.bincount(pairs.ravel(), minlength=len(x)) * w
        self.shared, self.sum = share[self.i] + share[self.j], w[self.i] + w[self.j]
        self.last = np.linalg.norm(x[self.i] - x[self.j], axis=1) - rest
        self.fresh = True

    def substep(self, h, iterations):
        start, moves = self.x, (self.w > 0)[:, None]
        self.d = moves * (h * self.d + h * h / 2 * self.g if self.fresh else self.d + h * h * self.g)
        self.x = start + self.d
        r = start[self.i] - start[self.j]
        length = np.linalg.norm(r, axis=1)
        s, C0 = r / length[:, None], length - self.rest
        alpha = self.alpha / h**2
        theta = 1 / (1 + (alpha / self.sum) ** 2)
        gamma = self.damping * self.alpha / h
        if self.fresh:
            A, B, alpha = theta + gamma, (1 - theta - gamma) * C0, 2 * alpha
        else:
            A = (1 - theta) / 4 + theta + gamma * (1 + theta) / 2
            B = ((1 - theta) / 2 - gamma * theta) * C0 + ((1 - theta) / 4 - gamma * (1 - theta) / 2) * self.last
        lam = np.zeros(len(self.rest))
        for _ in range(iterations):
            p = self.x[self.i] - self.x[self.j]
            now = np.linalg.norm(p, axis=1)
            u = p / now[:, None]
            cos = (s * u).sum(axis=1)
            turned = cos < 0.75
            n, cos = np.where(turned[:, None], u, s), np.where(turned, 1.0, cos)
            step = -(A * (now - self.rest) + B + alpha * lam) / (A * self.shared * cos + alpha)
            lam += step
            move = np.zeros_like(self.x)
            np.add.at(move, self.i, (self.w[self.i] * step)[:, None] * n)
            np.add.at(move, self.j, -(self.w[self.j] * step)[:, None] * n)
            self.x, self.d = self.x + move, self.d + move
        self.last, self.fresh = C0, False
