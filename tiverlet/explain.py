"""What a world is made of: the text behind world.explain()."""
def explain(world): return ""
