"""A fixed part of the fuzzer's scenes; python -m tests.fuzz runs as many as there is time for."""

import pytest

from .campaign import search
from .finds import FINDS
from .trials import HARD, Trial
from .twins import WAYS

# A structure for each of WAYS: few features each, which compile fast, and together most kinds.
STRUCTURES = (63, 1, 58, 58, 4, 5, 58)


@pytest.mark.slow
@pytest.mark.parametrize("k, way", list(zip(STRUCTURES, WAYS, strict=True)), ids=[way.__name__ for way in WAYS])
def test_random_scenes_keep_their_promises(taichi, k, way):
    # Energy of passive scenes, brute force, momentum, walls, equal bits: see trials.py. The scenes are the same in every run.
    searcher = search(3, k, 5, HARD, way)
    assert not searcher.found, searcher.says()
    assert searcher.refused < searcher.scenes


@pytest.mark.slow
@pytest.mark.parametrize("name", FINDS)
def test_finds_stay_mended(taichi, name):
    trial = Trial(FINDS[name][0])
    try:
        assert trial.run(FINDS[name][1]) == trial.replay(FINDS[name][1])
    finally:
        trial.close()
