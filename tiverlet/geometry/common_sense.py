"""The sense of triangles: two that share an edge have the same if they run along it in opposite directions."""

import numpy as np


def edges_of(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the edges of triangles (k, 3): their ends (e, 2), sorted; the edge of each side 01, 12, 20, (k, 3); and how many
    triangles each edge has, (e,)."""
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, which, number = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    return edges, which.reshape(-1, 3), number


def oriented(who: str, name: str, faces: np.ndarray, remedy: str = "") -> tuple[np.ndarray, np.ndarray]:
    """Return triangles (k, 3) of closed surfaces with the same sense on each, and the number of the surface of each, (k,).

    Raises ValueError for an edge that does not have two triangles, and for a surface with one side only. who, name: whose
    argument they are. remedy: what to do about such an edge.
    """
    edges, which, number = edges_of(faces)
    if (number != 2).any():
        e = int(np.argmax(number != 2))
        edge, k = tuple(edges[e].tolist()), int(np.argmax((which == e).any(axis=1)))
        why = "so the surface is open there" if number[e] == 1 else "but an edge of a closed surface has two"
        faces_there = "1 face" if number[e] == 1 else f"{number[e]} faces"
        raise ValueError(f"{who}: the edge {edge} of {name}[{k}] belongs to {faces_there}, {why}.{remedy}")
    turned, piece, wrong = common_sense(faces)
    if wrong >= 0:
        raise ValueError(f"{who}: {name}[{wrong}] and its neighbours have no common sense; the surface has only one side.")
    return np.where(turned[:, None], faces[:, ::-1], faces), piece


def common_sense(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return which triangles (k, 3) to reverse, so that those that share an edge with one other have the same sense, (k,).

    Also returns the connected piece of each, numbered in the order of their first triangles, which stay as they are, and a
    triangle of a surface with one side only, as a Moebius strip, where that is impossible; -1 if there is none.
    """
    _, which, number = edges_of(faces)
    order = np.argsort(which.ravel(), kind="stable")
    one, two = order[number[which.ravel()[order]] == 2].reshape(-1, 2).T
    start = faces.ravel()
    along = start[one] == start[two]  # both run along the edge the same way
    neighbours: list[list[tuple[int, bool]]] = [[] for _ in faces]
    for p, q, differ in zip((one // 3).tolist(), (two // 3).tolist(), along.tolist(), strict=True):
        neighbours[p].append((q, differ))
        neighbours[q].append((p, differ))
    turned, piece, wrong = np.zeros(len(faces), dtype=bool), np.full(len(faces), -1), -1
    for seed in range(len(faces)):
        if piece[seed] >= 0:
            continue
        piece[seed], queue = piece.max(initial=-1) + 1, [seed]
        while queue:
            p = queue.pop()
            for q, differ in neighbours[p]:
                if piece[q] < 0:
                    piece[q], turned[q] = piece[p], turned[p] ^ differ
                    queue.append(q)
                elif turned[q] != turned[p] ^ differ and wrong < 0:
                    wrong = p
    return turned, piece, wrong
