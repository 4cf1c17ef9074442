"""Known faults: cells of the matrix that do not keep their equality, and why. What is mended has to be struck out."""

ALONG = "damping acts along a free axis once the substep changes: the history of a Snap is not projected"
IMPACT = "a bounce off a wall beside contacts differs by a fraction of a substep from the bounce alone, which is exact"
BELT = "friction on a curved wall is of first order, alone and as a row"
PARTING = "beside contacts overlap parts 1.28 times as fast as push_out, and without velocity; alone it leaves with push_out"
ULP = "a digit depends on the unit of length"

KNOWN: dict[tuple[str, str], str] = {
    ("snaps", "late 0.25"): ALONG,
    ("snaps", "uneven"): ALONG,
    ("snaps", "changed back"): ALONG,
    ("angle limits", "units"): ULP,
    ("balls roll on balls", "units"): ULP,
    ("half spaces", "contact"): IMPACT,
    ("boxes", "contact"): IMPACT,
    ("capsules", "contact"): IMPACT,
    ("polygons as walls", "contact"): IMPACT,
    ("meshes", "contact"): IMPACT,
    ("half spaces", "polygons"): IMPACT,
    ("capsules", "polygons"): IMPACT,
    ("polygons as walls", "polygons"): IMPACT,
    ("balls", "contact"): BELT,
    ("balls", "polygons"): BELT,
    ("distance functions", "polygons"): BELT,
    ("distance functions", "contact"): BELT,
    ("what starts in walls", "contact"): PARTING,
    ("what starts in a mesh", "contact"): PARTING,
    ("discs meet", "f64"): "how fast overlap parts depends on rounding: passes end by a tolerance",
}
