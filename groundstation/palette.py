"""Robots' colours, the same in figures and viewers: Okabe and Ito's, distinguishable with every kind of colour blindness."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")


def colour(index: int) -> str:
    """The colour of the robot or pair at this place of the file."""
    return COLOURS[index % len(COLOURS)]
