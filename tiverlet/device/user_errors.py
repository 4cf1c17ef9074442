"""Errors of the compiler in a user's function, in few lines: where, why, and what to write instead."""

import re

from .language import HOME

# How the compiler names a place. Before the user's function it names a dozen of tiverlet's, which called it.
PLACE = re.compile(r'^(?:\w+ when calling `.*`: )?(File "(.+)", line \d+, in (.+)):$', re.MULTILINE)
TRACE = "Traceback (most recent call last):"
REMEDIES = {
    r"Return inside non-static": "A Taichi function returns once, at its end. Assign to a variable in each branch, return that.",
    r'Name "(\w+)" is not defined': "Define it above the function; if an if or for defines it, above that: {0} = 0.0",
    r"ufunc|numpy array": "NumPy does not run in kernels. Use ti.sqrt and its like, v.norm(), or ti.Vector([...]).",
    r"Cannot loop over the object <class '(?:list|tuple)'>": "Write for ... in ti.static(...): the loop is unrolled then.",
    r"only one of them is a tensor type": "A vector stands for a number. Arguments are passed by order, not by name.",
}


def shortened(error: Exception) -> Exception | None:
    """Return the same error with the place in the user's function, the reason and a remedy; None if it is elsewhere."""
    text = str(error)
    places = [m for m in PLACE.finditer(text) if not m[2].startswith(HOME)]
    if not places:
        return None
    last = places[-1]
    code, _, trace = text[last.end() :].strip("\n").rstrip(". \n").partition(TRACE)
    reason = trace.rstrip().rsplit("\n", 1)[-1]
    advice = "\n".join(
        remedy.format(*found.groups()) for why, remedy in REMEDIES.items() if (found := re.search(why, code + reason))
    )
    lines = [f"{last[3]} cannot be compiled:", f"{last[1]}:", code.rstrip(), reason, advice]
    return type(error)("\n".join(line for line in lines if line))
