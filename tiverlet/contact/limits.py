"""Numbers of the law of contacts that several of its parts share."""

RELAXATION = 1.3  # of split masses in a pass of impulses; beyond 1.6 passes diverge
FEW = 1e-30  # keeps divisors from being 0, and marks what presses with none
DIGIT = 1 / 8  # of the last two digits of a position: what rows of edges may lack where clusters place corners, to rounding
SLOW = 2.0  # times the displacement by forces: what comes together no faster does not bounce, but rests
FULL = 2.0**-10  # of the bound of friction: an impulse nearer to it than this is at the bound
SLIPS = 1 / 64  # of the displacement by forces, or of a push: less slip than this in a substep is what passes lack
SLOP = 0.003  # overlap that places leave, in radii of the smaller particle: contacts stay closed
BEYOND = 3.0  # times the slop: overlap from which on places are corrected. A pile rests in between, and is not stirred
AHEAD = 0.15  # of the smaller radius, or the median: pairs so near are rows already where one of them may be stopped
CLOSE = 2.0**-7  # of AHEAD radii: by how much links may be violated before places move them together
BLOCK = 64  # particles whose sums are added up first, so that sums have the same order on any number of threads
GROUP = 64  # blocks whose sums are added up first

FOREIGN, OWN = range(2)  # parts of the rows of a particle: those that a particle of a lower piece has, too, and its own
NEVER = 3.0  # a time after the substep
APART, NEAR, TOGETHER = range(3)  # what rows are before impacts in turn: near ones go on together, unless they meet by themselves
LACK, UPHILL, WORK, LOAD, ROWS, FORCE, HITS, WRONG, KINETIC = SUMS = range(9)  # sums over rows and particles
