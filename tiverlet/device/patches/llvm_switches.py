"""Switches of LLVM: kernels start in half of the time, bit for bit the same.

For a loop whose length is known only at run time, LLVM writes up to eight rounds one after the other, and peels first rounds off
in front of it. All later passes work on these copies. Frames take as long without them, since tiverlet's loops wait for memory
and square roots. LLVM also spends a twelfth of its time on a second search for addresses that loops compute by fewer additions.
Frames of a pile take 1 % less for it, those of boxes do not. Kernels of small worlds, and long ones, do without.

Taichi has no setting for this. But LLVM is part of its library, and reads switches as from a command line
(LLVMParseCommandLineOptions, of its C API). Where its functions are not found (another system, a stripped library), no switch is
set.
"""

from .library import command_line

SWITCHES = (
    "-unroll-runtime=false",  # loops whose length is known only at run time
    "-unroll-max-upperbound=0",  # loops with a known upper bound of rounds only
    "-unroll-allow-peeling=false",  # copies of first rounds
)
NO_SEARCH = ("-disable-lsr",)


def set_switches(search: bool) -> None:
    """Have LLVM leave loops as they are in kernels compiled until restore_switches(), and, unless told to, not search."""
    line = command_line()
    if line and not line.given:
        line.set_switches(*SWITCHES, *(() if search else NO_SEARCH))


def restore_switches() -> None:
    """Have LLVM compile as by default."""
    line = command_line()
    if line and line.given:
        line.reset_switches()
