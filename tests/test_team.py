"""How work is dealt to the threads of a team."""

import numpy as np

from tiverlet.device import ti
from tiverlet.device.memory import Memory
from tiverlet.device.thread_team import Team

DEALS = ((1, 1), (7, 1), (16, 4), (23, 4), (64, 8))  # number of things, number per unit


@ti.data_oriented
class Dealt:
    """Which thread got each thing: a row for each of DEALS."""

    def __init__(self, size: int):
        memory = Memory(ti.f32)
        self.team = Team(memory, size, 1000, False, pieces=16)
        self.who = memory.field("who", len(DEALS) * 64, kind=ti.i32)
        self.times = memory.field("times", len(DEALS) * 64, kind=ti.i32)
        memory.place()
        self.memory = memory

    @ti.kernel
    def deal(self, active: ti.i32):
        """Run the threads one after the other."""
        self.team.active_threads[None] = active
        for k in range(ti.static(len(DEALS) * 64)):
            self.times[k] = 0
        for _ in range(1):
            for me in range(active):
                for row in ti.static(range(len(DEALS))):
                    for k in range(self.team.dealt_count(DEALS[row][0], DEALS[row][1], me)):
                        at = row * 64 + self.team.dealt_index(k, DEALS[row][1], me)
                        self.who[at] = me
                        self.times[at] += 1


def test_all_is_dealt_out_once_there_and_back():
    # By units, 0 1 2 2 1 0 0 1 2 ... for three threads, whatever is left for the last turn.
    dealt = Dealt(5)
    for active in range(1, 6):
        dealt.deal(active)
        who, times = (dealt.memory.read(field).reshape(len(DEALS), 64) for field in (dealt.who, dealt.times))
        for row, (n, unit) in enumerate(DEALS):
            units = np.arange(n) // unit
            turn, place = units // active, units % active
            assert (times[row, :n] == 1).all() and (times[row, n:] == 0).all(), (active, n, unit)
            assert (who[row, :n] == np.where(turn % 2 == 0, place, active - 1 - place)).all(), (active, n, unit)
    dealt.memory.destroy()
