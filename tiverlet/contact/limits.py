"""The numbers of the law of contacts."""

RELAXATION = 1.3  # of split masses in a pass of impulses; beyond 1.6 passes diverge
FEW = 1e-30  # keeps divisors from being 0, and marks what presses with none
ALONE = 1.001  # by what masses are split where a row shares its particles with none, to rounding
MET = 0.0005  # of the displacement by forces in a substep: what rows may lack. It adds up over the height of a pile
DIGIT = 1 / 8  # of the last two digits of a position: what rows of edges may lack where clusters place corners, to rounding
PASSES = 20  # most passes of impulses in a substep
LANDS = 0.2  # of the displacement by forces: where rows lack more after PASSES, something lands
BOUNCES = 200  # most of them where anything bounces or lands: the impulse has to reach the other end of what touches
LEAST = 6, 3  # fewest of them, without and with friction: what rests comes to rest down to rounding
MOMENTUM = 10.0  # Nesterov's theta of the first pass, after about twice as many
LEFT = 1e-7  # share of the mean square of what rows lack in the first pass that may be left, where no forces act
ERROR = 0.002  # of the kinetic energy of all: the energy that may be wrong after a bounce
ROUNDING = 0.1  # of what rows may lack: times the impulses, the work that they may do
SLOW = 2.0  # times the displacement by forces: what comes together no faster does not bounce, but rests
STEADY = 1 / 16  # of an impulse: it may change by so much in a substep, beside what forces change, and be a load
CRADLE = 0.97  # coefficient of restitution above which a world lets impacts pass on one after the other
NOISE = 64.0  # times the rounding of a displacement: what comes together no faster is at rest
SLOP = 0.003  # overlap that places leave, in radii of the smaller particle: contacts stay closed
BEYOND = 3.0  # times the slop: overlap from which on places are corrected. A pile rests in between, and is not stirred
MOVES = 8  # most passes of places in a substep
AHEAD = 0.15  # of the smaller radius, or the median: pairs so near are rows already where one of them may be stopped
QUARTER = 0.25  # of the smaller radius: by how much a pair that overlaps parts in a substep at most
SHARE = 1.2  # of an overlap that a pass of places moves, by masses split by the largest eigenvalue; below 4/3
CLOSE = 2.0**-7  # of AHEAD radii: by how much links may be violated before places move them together
BLOCK = 64  # particles whose sums are added up first, so that sums have the same order on any number of threads

FOREIGN, OWN = range(2)  # parts of the rows of a particle: those that a particle of a lower piece has, too, and its own
LACK, UPHILL, WORK, LOAD, ROWS, FORCE, HITS, WRONG, KINETIC = SUMS = range(9)  # sums over rows and particles
# Numbers of the passes. LANDING: what rows lack in impacts. ALLOWED: work per impulse that is rounding [m]
BETA, THETA, TOLERANCE, LANDING, ALLOWED = range(5)
H, BEGIN, END, SCALE, WHOLE, SHARES = TIMES = range(6)  # what rows know of a substep, see Rows.times
ROUNDS, IMPULSES, PLACES = range(3)  # kinds of passes: of impacts in turn, of stage 1, of stage 2
GOING, TURN, GAINS, STRUCK = range(4)  # whether another pass follows, its number, whether any particle gains energy, or bounces
THROWN = 0.5  # of the median radius: how far impacts in turn may throw something in a substep and it still meets others
NEVER = 3.0  # a time after the substep
APART, NEAR, TOGETHER = range(3)  # what rows are before impacts in turn: near ones go on together, unless they meet by themselves
GROUP = 64  # blocks whose sums are added up first
