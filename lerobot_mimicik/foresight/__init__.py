"""A learned step that sees through the trembling of a hand, in numpy: no torch at run time."""
