"""Pairs that are solved once have the bits of pairs that each particle solves for itself, on all threads."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.contact import Contact


def heap(with_large: bool):
    """Return some 1100 discs; with_large: some pinned, and two large ones that touch each other and over 32 discs each.

    The first two, far above, are to be linked: contacts of worlds without constraints are rows.
    """
    k = np.arange(1400 if with_large else 1100)
    x = np.stack([k % 36 * 1.01, k // 36 * 1.01], axis=1) + 0.5 + 0.01 * tv.golden(k, dim=2)
    radius, pinned = np.full(len(k), 0.5), []
    if with_large:
        centers = np.array([[12.0, 14.0], [25.01, 14.0]])
        apart = np.linalg.norm(x[:, None] - centers, axis=2).min(axis=1) > 7.01
        x = np.vstack([np.insert(x[apart], 500, centers[0], axis=0), centers[1]])  # in the middle, and behind all others
        radius, pinned = np.full(len(x), 0.5), [40, 41, 42, 700]
        radius[[500, -1]] = 6.5
    x, radius = np.vstack([[[10.0, 58.0], [12.0, 58.0]], x]), np.append([0.5, 0.5], radius)
    return tv.Particles(x, velocity=[18.0, 14.0] - x, mass=2.0, radius=radius, pinned=[i + 2 for i in pinned])


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"friction": 0.4}, {"friction": 0.4, "loads": True}], ids=str)
def test_pairs_solved_once_have_the_bits_of_pairs_solved_from_both_sides(world, monkeypatch, briefly, options):
    # The push on j is the opposite of that on i to the bit, and pushes are added up in the order of the list either way. Loads
    # are learnt in windows of 128 substeps, so there are 140. Lists of large discs need a second word of bits.
    states = []
    for path, once in (("parallel", True), ("fused", False)):
        if not once:
            monkeypatch.setattr(Contact, "_solves_once", lambda *_: False)
        box = tv.Box((0, 0), (37, 60), friction=0.4)
        features = [tv.Gravity(9.81), box, tv.Contact(skin=0.8, **options), tv.Distance([[0, 1]], compliance=1e-3)]
        w = world(heap("loads" not in options), features, path=path, substeps=4)
        assert w.features[2].once == once
        for _ in range(35):
            w.step(1 / 60)
        listed = np.bincount(w.features[2].dev.list.entries()[0][:, 0])
        assert w.last.contacts > 600 and ((listed > 32).sum() == 2 or "loads" in options)
        states.append((w.hash(), w.velocity))
    (one, velocity), (other, expected) = states
    assert one == other and (velocity == expected).all()
