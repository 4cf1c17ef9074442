"""Colours for the strain of links."""

import numpy as np

# Range of |strain|, on a logarithmic scale: up to LEAST the colour is neutral, from MOST on it is full.
LEAST, MOST = 1e-4, 1e-1
LEVELS = 12  # colours on each side: four to a decade
NEUTRAL, LONGER, SHORTER = (np.array(c, dtype=np.float64) for c in ([170, 172, 182], [255, 92, 48], [64, 140, 255]))


def packed(rgb: np.ndarray) -> np.ndarray:
    """Return red, green and blue in 0 ... 255, (n, 3), as RGBA in u32, (n,)."""
    rgb = np.rint(rgb).astype(np.uint32)
    return rgb[:, 0] << 24 | rgb[:, 1] << 16 | rgb[:, 2] << 8 | np.uint32(255)


def _scale() -> np.ndarray:
    """Return RGBA as u32 from the most compressed to the most stretched link: blue, grey at rest, red."""
    side = np.linspace(0.0, 1.0, LEVELS + 1)[:, None]
    shorter, longer = (NEUTRAL + side * (end - NEUTRAL) for end in (SHORTER, LONGER))
    return packed(np.concatenate([shorter[:0:-1], longer]))


SCALE = _scale()


def levels(strain: np.ndarray) -> np.ndarray:
    """Return the index in SCALE of each strain (m,): LEVELS at rest or without a strain (NaN), more for stretched links."""
    strain = np.nan_to_num(strain.astype(np.float32), nan=0.0)
    share = np.log2(np.clip(np.abs(strain), LEAST, MOST) / LEAST) / np.log2(MOST / LEAST)
    return LEVELS + np.rint(np.copysign(LEVELS * share, strain)).astype(np.int32)


def tinted(hues: np.ndarray, at: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return colours (n, 3) that turn red or blue with strain, from 1 % on.

    at: the row of `hues` that shows each link, (m,); each row shows its worst. level: that of each link, (m,); -1: not drawn.
    """
    off, most = np.where(level < 0, 0, level - LEVELS), np.zeros(len(hues), dtype=np.int64)
    np.maximum.at(most, at, 2 * np.abs(off) + (off > 0))
    share = np.maximum(0, 3 * (most >> 1) / LEVELS - 2)[:, None]  # 0 up to 1 % of strain, 1 at 10 %
    return hues + share * (np.where((most & 1)[:, None], LONGER, SHORTER) - hues)


def legend() -> tuple[np.ndarray, list[str]]:
    """Return colours and labels of the scale, from the most compressed to the most stretched."""
    decades = np.array([1e-1, 1e-2, 1e-3])
    strain = np.concatenate([-decades, [0.0], decades[::-1]])
    return SCALE[levels(strain)], [f"{100 * s:+g} %" if s else "at rest" for s in strain]
